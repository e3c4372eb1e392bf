"""The command `calibrate`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from typer import Option

import orthocal
from orthocal.cli.files import load_each_once
from orthocal.cli.options import command, read_tolerances, split_globs
from orthocal.cli.overwriting import require_replaceable_results
from orthocal.cli.printing import deliver_judged, judgement_on_failure

FILES = ("calibration.json", "report.html")


@dataclass(frozen=True, slots=True, kw_only=True)
class ChoiceOptions:
    """Options about the errors to identify and what is known of them.

    Args:
        known (NAME=VALUE[±TOL]): Known error, fixed or with a tolerance:
            x_leg.length_mm=0.12±0.02 (or +-).
        prior: Use the tolerances in the fit; default: yes, except where only offsets are
            identified.
        bound (PATTERN=LOW:HIGH): Bounds such as 'x_slide.offset_mm=-2:2', or of one side '=-2:'.
        base: For research: estimate the combinations that readings determine, without tolerances.
    """

    model: str | None = None
    free: list[str] | None = None
    effects: str | None = None
    known: list[str] | None = None
    tolerance: list[str] | None = None
    prior: Annotated[bool | None, Option("--prior/--no-prior")] = None
    bound: list[str] | None = None
    base: bool = False

    def read(self, session: orthocal.Session) -> orthocal.Choice:
        """Choice for a session with the effects, by default its own.

        Raises:
            ParameterError: If an option is malformed, or does not fit the robot.
        """
        from orthocal.estimation.choice import resolve_choice
        from orthocal.estimation.selection import read_bounds, read_known

        parameters = session.robot.parameters
        choice = orthocal.Choice(
            model=self.model,
            free=split_globs(self.free),
            prior=self.prior,
            known=read_known(self.known or [], parameters, where="--known"),
            tolerances=read_tolerances(self.tolerance, session.robot),
            bounds=read_bounds(self.bound or [], parameters, where="--bound"),
            base=self.base,
        )
        choice = resolve_choice(choice, session)
        choice.select(parameters)  # refuses a wrong choice before the readings are judged
        return choice


@command()
def calibrate(
    sessions: list[Path],
    *,
    choice: ChoiceOptions,
    loss: str = "squares",
    solver: str = "ipopt",
    profile: list[str] | None = None,
    out: Path | None = None,
    json: bool = False,
    details: bool = False,
    all_: bool = False,
    force: bool = False,
) -> None:
    """Identify the errors of a machine and the offsets to enter.

    With --out the directory receives calibration.json and report.html.

    Exit code 3: the verdict is not `enter`; the reason is printed. All results are written
    nevertheless, unless the solver fails.

    Args:
        loss (squares|huber): For research: loss function of the residuals; huber reduces the
            weight of outliers.
        solver (ipopt|variable-projection|linearised): For research: reference, variable projection
            (faster), or first order as in the paper.
        profile (PATTERNS): For research: profile-likelihood intervals of these errors (slow).
    """
    if out is not None:
        require_replaceable_results(out, dict.fromkeys(FILES, ""), force=force)
    loaded = load_each_once(sessions, effects=choice.effects, tolerance=choice.tolerance)
    session = orthocal.join_sessions(loaded)
    chosen = choice.read(session)
    options = orthocal.SolverOptions(
        solver=solver,  # type: ignore[arg-type] # checked by SolverOptions
        loss=orthocal.Loss(loss),  # type: ignore[arg-type] # checked by Loss
    )
    judgement = orthocal.judge_session(session)
    with judgement_on_failure(session, judgement, json=json, details=details):
        result = orthocal.calibrate(
            session,
            chosen,
            solver=options,
            profile=split_globs(profile),
            judgement=judgement,
        )
    shown = {"details": details, "all_rows": all_, "saved": out}
    deliver_judged(result, json=json, out=out, files=lambda: _build_files(result, out), **shown)


def _build_files(result: orthocal.Calibration, out: Path | None) -> dict[str, str]:
    """Texts of `FILES`, by name."""
    from orthocal.calibration.file import calibration_json
    from orthocal.output.report.page import build_report

    texts = (calibration_json(result), build_report(result, saved=out))
    return dict(zip(FILES, texts, strict=True))
