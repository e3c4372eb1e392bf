"""Print whether commands agree on simulated machines, and whether their promises hold.

python tests/benchmarks/machines.py                  three machines of every plan
python tests/benchmarks/machines.py --machines 100   the long form
python tests/benchmarks/machines.py --plan first     another plan, such as one of `orthocal plan`

Machines have none, one, two or three mistakes in their readings, their offsets entered or not, one
session or two. If a calibration says to enter its offsets, another session is measured with them:
without a mistake, with one in its readings, or with other offsets than it states. `validate` then
has the verdict of `check` and `calibrate` on all sessions.

Exit code 1 if verdicts differ, or if a promise of the sessions without a mistake is not kept: the
tool error, or the coverage of the intervals.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
from collections import Counter
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).parents[1]))

import numpy as np
from commands import run_orthocal
from intervals import FEWEST, LIMIT, coverage_band, recorded_scores
from made_mistakes import Sheet, plain_mistakes, sound_machine

from orthocal import (
    Machine,
    assess_tool,
    load_calibration,
    load_plan,
    simulate_session,
    write_session,
)
from orthocal.assessment.controller_entries import entered_offsets, offsets_to_enter
from orthocal.errors import OrthocalError
from orthocal.units import MM

EXAMPLES = ("raw-cycles", "sweep", "workshop")
ROOT = Path(__file__).parents[2]
WITHIN = 1.15
"""Largest ratio of the RMS tool error over machines to the predicted one."""

FEWEST_MACHINES = 20
"""Sound machines below which the tool error is not judged: of one it varies by a third."""


@dataclass
class Counts:
    """Results of the machines of one plan."""

    verdicts: Counter = field(default_factory=Counter)
    """Machines by number of mistakes and verdict."""
    validated: Counter = field(default_factory=Counter)
    """Sessions with calibrated offsets by their mistake and the answer of `validate`."""
    differing: list = field(default_factory=list)
    """Seeds of machines about which commands differ, and their verdicts."""
    tool: list = field(default_factory=list)
    """Tool error with the entered offsets and its prediction, of sound machines, [m]."""
    covered: list = field(default_factory=list)
    """Whether independent 95 % intervals contain the true value."""


def spoil(session, rng, mistakes):
    """A session with several mistakes of any kind, one after the other."""
    makes = list(plain_mistakes().values())
    while mistakes:
        made = makes[rng.integers(len(makes))](Sheet(session, rng))
        if made is not None and not np.array_equal(made.values, session.values):
            session, mistakes = session.with_values(made.values), mistakes - 1
    return session


AGAIN = ("no mistake", "wrong reading", "offsets not entered", "offsets reversed")
"""Mistakes of the session that is measured with the calibrated offsets."""


def measure_again(plan, errors, calibration, seed):
    """Session that states the offsets of a calibration, and its mistake; None out of reach."""
    before, stated = calibration.active_offsets, offsets_to_enter(calibration)
    rng = np.random.default_rng((seed, 6))
    mistake = AGAIN[rng.integers(len(AGAIN))]
    actual = {AGAIN[2]: before, AGAIN[3]: 2.0 * before - stated}.get(mistake, stated)
    try:
        session = simulate_session(
            plan.with_controller(actual), errors, seed=20_000 + seed
        ).session.with_controller(stated)
    except OrthocalError:
        return None
    if mistake == AGAIN[1]:
        session = spoil(session, rng, 1)
    return session, mistake


def validate(folder, before, session, mistake, counts):
    """Verdicts on sessions with another one that was measured after their calibration."""
    write_session(session, folder / "again")
    done = run_orthocal(folder, "validate", "full", "again", "--json")
    if done.returncode == 2:  # with the stated offsets a posture is beyond the travel
        counts.validated[mistake, None, "refused"] += 1
        return {"validate": "refused"}
    document = json.loads(done.stdout)
    # without a solution there is no answer about the older calibration
    decision, confirmed = document["decision"], document.get("confirmed")
    counts.validated[mistake, confirmed, decision["verdict"]] += 1
    verdicts = {"validate": decision["verdict"]}
    if done.returncode != (0 if confirmed and decision["verdict"] == "enter" else 3):
        verdicts["validate"] = "other exit code"
    for name in ("check", "calibrate"):
        done = run_orthocal(folder, name, *before, "again", "--json")
        verdicts[name] = json.loads(done.stdout)["decision"]["verdict"]
    return verdicts


def find_verdicts(folder, sessions):
    """Verdict of each command; of `record` and `export`, whether it is to enter."""
    commands = {
        "check": ["check", *sessions],
        "calibrate": ["calibrate", *sessions],
        "calibrate full": ["calibrate", *sessions, "--model", "full", "--out", "full"],
        "compare": ["compare", *sessions, "--models", "offsets"],
    }
    verdicts = {}
    for name, words in commands.items():
        done = run_orthocal(folder, *words, "--json")
        known = done.returncode in (0, 3) and done.stdout.startswith("{")
        decision = json.loads(done.stdout)["decision"] if known else {"exit_code": done.returncode}
        agrees = decision["exit_code"] == done.returncode
        verdicts[name] = decision.get("verdict", "refused") if agrees else "other exit code"
    # where nothing was calibrated there is nothing to export
    if (folder / "full/calibration.json").exists():
        done = run_orthocal(folder, "export", "full", "--to", "yaml", "--out", "exported")
        verdicts["export"] = {0: "enter"}.get(done.returncode, "not enter")
    return verdicts


def record(folder, name, session):
    """Whether `record` asks to correct readings that are typed into the plan of a session."""
    source, blank = folder / name, folder / "typed"
    blank.mkdir()
    (blank / "session.yaml").write_text((source / "session.yaml").read_text())
    head, *rows = (source / "readings.csv").read_text().splitlines()
    at = head.split(",").index("reading_mm")
    cells = [row.split(",") for row in rows]
    for cell in cells:
        cell[at] = ""
    lines = [head, *(",".join(cell) for cell in cells)]
    (blank / "readings.csv").write_text("\n".join(lines) + "\n")
    typed = "".join(f"{v / MM:.6f}\n" for v in session.values)
    done = run_orthocal(folder, "record", "typed", typed=typed)
    if "readings are recorded." not in done.stdout:
        return "refused"
    return "not enter" if "correct or repeat these readings" in done.stdout else "enter"


def agree(verdicts):
    """Whether all verdicts are one, some of them known only as 'not enter'."""
    exact = {v for v in verdicts.values() if v != "not enter"}
    return len(exact) == 1 and (
        "not enter" not in verdicts.values() or exact <= {"review", "reject"}
    )


def examine(folder, plan, seed, counts):
    """Simulate one machine, ask every command, and compare what it promises with the truth."""
    mistakes, entered, two = seed % 4, seed // 4 % 2 == 1, seed // 8 % 2 == 1
    errors, first = sound_machine(plan, seed, entered=entered)
    first = spoil(first, np.random.default_rng((seed, 5)), mistakes)
    sessions = {"first": first}
    if two:
        near = [errors[f"{d.name}.offset"] for d in plan.robot.drives]
        with suppress(OrthocalError):  # beyond the gauge's range
            sessions["second"] = simulate_session(
                plan.with_controller(near), errors, seed=10_000 + seed
            ).session
    for name, session in sessions.items():
        write_session(session, folder / name)
    verdicts = find_verdicts(folder, sessions)
    if len(sessions) == 1 and "refused" not in verdicts.values():
        verdicts["record"] = record(folder, "first", first)
    counts.verdicts[mistakes, verdicts["check"]] += 1
    if not agree(verdicts):
        counts.differing.append((seed, verdicts))
    if verdicts["calibrate full"] != "enter":
        return
    calibration = load_calibration(folder / "full")
    again = measure_again(plan, errors, calibration, seed)
    if again is not None:
        verdicts = validate(folder, sessions, *again, counts)
        if not agree(verdicts):
            counts.differing.append((seed, again[1], verdicts))
    if not mistakes:
        keep_promises(calibration, errors, counts)


def keep_promises(calibration, errors, counts):
    """Compare the tool error and the intervals of a calibration with the truth."""
    robot, tool = calibration.robot, assess_tool(calibration)
    drives = Machine(robot, {}).inverse(tool.targets) - entered_offsets(calibration)
    reached = Machine(robot, errors).forward(drives)
    left = tool.measure(reached - tool.targets).aligned.rms
    counts.tool.append((left, calibration.assessment.tool.entered))
    counts.covered.extend(np.abs(recorded_scores(calibration, errors)[0]) < LIMIT)


def show(line):
    """Print a line at once."""
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


def report(name, counts):
    """Print the results of a plan; whether every promise is kept."""
    show(f"\n{name}")
    for (mistakes, verdict), number in sorted(counts.verdicts.items()):
        show(f"  {mistakes} mistakes, {verdict}: {number}")
    for (mistake, confirmed, verdict), number in sorted(counts.validated.items(), key=str):
        show(f"  again with {mistake}: {verdict}, confirmed {confirmed}: {number}")
    for seed, *verdicts in counts.differing:
        show(f"  machine {seed}: {verdicts}")
    kept = not counts.differing
    if counts.tool:
        left, promised = np.sqrt(np.mean(np.square(counts.tool), axis=0))
        show(f"  tool error {left * 1e6:.1f} µm, predicted {promised * 1e6:.1f} µm")
        show(f"  ratio {left / promised:.2f} of {len(counts.tool)} machines (at most {WITHIN})")
        kept &= len(counts.tool) < FEWEST_MACHINES or left < WITHIN * promised
    covered, n = sum(counts.covered), len(counts.covered)
    if n:
        low, high = coverage_band(n)
        show(f"  {covered} of {n} intervals contain the truth (99 % band {low:.0f} to {high:.0f})")
        kept &= n < FEWEST or low <= covered <= high
    return kept


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--machines", type=int, default=3, help="of every plan")
    parser.add_argument("--first", type=int, default=0, help="seed of the first machine")
    parser.add_argument("--example", action="append", choices=EXAMPLES, default=[])
    parser.add_argument("--plan", action="append", type=Path, default=[])
    given = parser.parse_args()
    kept = True
    examples = given.example if given.example or given.plan else EXAMPLES
    for path in [*(ROOT / "examples" / e / "plan.yaml" for e in examples), *given.plan]:
        plan, counts = load_plan(path), Counts()
        for seed in range(given.first, given.first + given.machines):
            with tempfile.TemporaryDirectory() as folder:
                examine(Path(folder), plan, seed, counts)
        kept &= report(path, counts)
    sys.exit(0 if kept else 1)


if __name__ == "__main__":
    main()
