"""What readings would be: simulate."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from orthocal.cli.options import (
    Tolerances,
    app,
)
from orthocal.cli.printing import put_note
from orthocal.errors import ParameterError, SessionError


@app.command()
def simulate(
    plan: Annotated[
        Path,
        typer.Argument(metavar="PLAN", help="A session.yaml without readings, or a session."),
    ],
    out: Annotated[Path, typer.Option(help="Folder for session.yaml, readings.csv, truth.yaml.")],
    errors: Annotated[
        Path | None, typer.Option(help="YAML file with the machine's errors (see a truth.yaml).")
    ] = None,
    error: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME=VALUE", help="One error, such as x_slide.offset_mm=1.2."),
    ] = None,
    draw: Annotated[
        str | None,
        typer.Option(
            metavar="MODEL|GLOBS",
            help="Draw errors from the tolerances: a model, or names and globs with commas.",
        ),
    ] = None,
    tolerance: Tolerances = None,
    seed: Annotated[int, typer.Option(min=0, help="Of noise, gauge zeros and drawn errors.")] = 0,
    exact: Annotated[
        bool, typer.Option("--exact", help="No noise, no gauge zeros, no rounding.")
    ] = False,
    force: Annotated[
        bool, typer.Option("--force", help="Write over a session that is there.")
    ] = False,
) -> None:
    """Make a session of simulated readings of a machine whose errors are known."""
    from orthocal.estimation.selection import read_tolerances
    from orthocal.io.files import exists, require_writable
    from orthocal.measurement.files.session_file import load_plan
    from orthocal.measurement.files.write_session import write_session
    from orthocal.observation.simulate import (
        collect_errors,
        simulate_session,
        truth_document,
    )

    require_writable(out)
    for name in ("session.yaml", "readings.csv", "truth.yaml"):
        if exists(out / name) and not force:
            raise SessionError("is there already; --force writes over it", where=str(out / name))
    planned = load_plan(plan)
    tolerances = read_tolerances(tolerance or [], planned.robot.parameters, where="--tolerance")
    if tolerances and draw is None:
        raise ParameterError("is of no use without --draw", where="--tolerance")
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
    comment = "Simulated readings, not measured. The truth behind them is in truth.yaml."
    path = write_session(simulated.session, out, comment=comment, extra=truth)
    put_note(f"Wrote {path}, {len(simulated.session.readings)} simulated readings, and truth.yaml")
