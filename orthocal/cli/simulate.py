"""The command `simulate`."""

from __future__ import annotations

from pathlib import Path

import orthocal
from orthocal.cli.files import load_stated_plan
from orthocal.cli.options import OutDirectory, Seed, command, state_tolerances
from orthocal.cli.overwriting import require_new_session
from orthocal.cli.printing import put_note
from orthocal.text import quote_path


@command()
def simulate(
    plan: Path,
    out: OutDirectory,
    error: list[str] | None = None,
    errors: Path | None = None,
    draw: str | None = None,
    effects: str | None = None,
    temperature: str | None = None,
    tolerance: list[str] | None = None,
    exact: bool = False,
    seed: Seed = 0,
    force: bool = False,
) -> None:
    """Simulate the readings of a machine with known errors.

    The directory receives session.yaml, readings.csv and truth.yaml. Readings state the conditions
    that effects of the machine need, and their time and temperature with --temperature. With the
    truth.yaml of an earlier session (--errors) machine and gauges are the same, mounted again.
    Errors of other gauges are drawn and printed. If the sessions state different mechanical
    adjustments (adjusted_mm), the machine is adjusted.

    Args:
        draw (MODEL|PATTERNS): Draw random errors by their tolerances: those of a model, or by name
            or pattern ('*': all).
        effects (EFFECTS): Effects of the machine, such as backlash,thermal, or none; default:
            those that the plan states, else those of the robot.
        exact: Without noise, gauge zeros and rounding.
    """
    from orthocal.observation.sensor_groups import nuisance_parameters
    from orthocal.observation.simulate import collect_errors, drawn_gauge_errors, truth_document
    from orthocal.session.points import count_readings

    require_new_session(out, ("session.yaml", "readings.csv", "truth.yaml"), force=force)
    planned = load_stated_plan(plan, effects=effects, temperature=temperature)
    planned = state_tolerances(planned, tolerance)
    true_errors = collect_errors(
        planned.robot,
        file=errors,
        single=error or [],
        draw=draw,
        nuisance=nuisance_parameters(planned).parameters,
        adjusted=planned.adjusted,
        seed=seed,
    )
    simulated = orthocal.simulate_session(planned, true_errors, seed=seed, exact=exact)
    truth = {"truth.yaml": truth_document(simulated)}
    comment = "Simulated readings, not measured. The true errors are in truth.yaml."
    path = orthocal.write_session(simulated.session, out, comment=comment, extra=truth)
    count = count_readings(simulated.session)
    put_note(f"Wrote {path}, {count} simulated readings, and truth.yaml")
    drawn = {} if errors is None else drawn_gauge_errors(simulated, true_errors)
    if drawn:
        values = ", ".join(f"{key} {value:.4g}" for key, value in drawn.items())
        put_note(
            f"Drawn, because {errors} does not state these errors of gauges: {values}. To simulate "
            f"the same gauges again: --errors {quote_path(out / 'truth.yaml')}"
        )
