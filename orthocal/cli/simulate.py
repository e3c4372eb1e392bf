"""The command `simulate`."""

from __future__ import annotations

from typing import Annotated

from typer import Option

from orthocal.cli.files import require_new_files
from orthocal.cli.options import (
    Error,
    Errors,
    Force,
    OutDirectory,
    PlanPath,
    Seed,
    Tolerances,
    app,
)
from orthocal.cli.printing import put_note
from orthocal.errors import ParameterError

FILES = ("session.yaml", "readings.csv", "truth.yaml")


@app.command()
def simulate(
    plan: PlanPath,
    out: OutDirectory,
    error: Error = None,
    errors: Errors = None,
    draw: Annotated[
        str | None,
        Option(
            metavar="MODEL|GLOBS",
            help="Draw normally distributed errors by their tolerances: of a model, or of names "
            "and globs.",
        ),
    ] = None,
    tolerance: Tolerances = None,
    exact: Annotated[
        bool, Option("--exact", help="Without noise, gauge zeros and rounding.")
    ] = False,
    seed: Seed = 0,
    force: Force = False,
) -> None:
    """Simulate the readings of a machine with known errors.

    The directory receives session.yaml, readings.csv and truth.yaml.
    """
    from orthocal.estimation.selection import read_tolerances
    from orthocal.measurement.files.session_file import load_plan
    from orthocal.measurement.files.write_session import write_session
    from orthocal.observation.simulate import collect_errors, simulate_session, truth_document

    require_new_files(out, FILES, force=force)
    planned = load_plan(plan)
    tolerances = read_tolerances(tolerance or [], planned.robot.parameters, where="--tolerance")
    if tolerances and draw is None:
        raise ParameterError("has no effect without --draw", where="--tolerance")
    true_errors = collect_errors(
        planned.robot,
        file=errors,
        single=error or [],
        draw=draw,
        tolerances=tolerances,
        seed=seed,
    )
    simulated = simulate_session(planned, true_errors, seed=seed, exact=exact)
    truth = {"truth.yaml": truth_document(simulated)}
    comment = "Simulated readings, not measured. The true errors are in truth.yaml."
    path = write_session(simulated.session, out, comment=comment, extra=truth)
    put_note(f"Wrote {path}, {len(simulated.session.readings)} simulated readings, and truth.yaml")
