"""The command line. The only place that prints, and that turns errors into exit codes.

Imports of anything slow stand inside the commands: help answers at once.
"""

from __future__ import annotations

import io
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

import orthocal
from orthocal.errors import OrthocalError, ParameterError, SessionError

if TYPE_CHECKING:
    from orthocal.identification.calibration import Calibration
    from orthocal.study.validation import Validation

app = typer.Typer(
    add_completion=False,
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    help="Calibrate Orthoglide-type parallel robots from dial-indicator readings.",
)

SessionPath = Annotated[
    Path, typer.Argument(metavar="SESSION", help="session.yaml, or the folder that holds it.")
]
CalibrationPath = Annotated[
    Path,
    typer.Argument(metavar="CALIBRATION", help="calibration.json, or the folder that holds it."),
]
Json = Annotated[bool, typer.Option("--json", help="Print the result as JSON on stdout.")]
Tolerances = Annotated[
    list[str] | None,
    typer.Option(
        metavar="GLOB=VALUE",
        help="Another tolerance than the robot's, such as '*.offset_mm=2'.",
    ),
]
AllRows = Annotated[bool, typer.Option("--all", help="List every reading, however many.")]


def main() -> None:
    """Run the command line; no traceback ever reaches a user.

    Exit codes: 0 done, 1 a solve did not converge, 2 bad input, 70 a bug of ours.
    """
    import os

    for stream in (sys.stdout, sys.stderr):  # a terminal without ± prints a question mark
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")
    try:
        app()
    except OrthocalError as e:
        _note(f"orthocal: {e}")
        sys.exit(e.exit_code)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(0)
    except Exception as e:
        if os.environ.get("ORTHOCAL_DEBUG"):
            raise
        _note(
            f"orthocal: this is a bug of orthocal, not of your input: {type(e).__name__}: {e}\n"
            "Set ORTHOCAL_DEBUG=1 to see where, and report it."
        )
        sys.exit(70)


@app.callback(invoke_without_command=True)
def _version(
    version: Annotated[
        bool, typer.Option("--version", help="Print the version.", is_eager=True)
    ] = False,
) -> None:
    if version:
        _out(orthocal.__version__)
        raise typer.Exit


@app.command()
def calibrate(
    session: SessionPath,
    model: Annotated[
        str | None,
        typer.Option(
            help="Which errors are free: offsets (the default), lengths, full, or one of the "
            "robot's own.",
        ),
    ] = None,
    free: Annotated[
        list[str] | None,
        typer.Option(
            metavar="GLOBS",
            help="Names or globs, with commas, that are free too, or instead where no --model is "
            "given; '!' takes out: --model full --free '!*_fork.*'.",
        ),
    ] = None,
    prior: Annotated[
        bool | None,
        typer.Option(
            "--prior/--no-prior",
            help="Whether tolerances act as a prior; by default not for offsets, else yes.",
        ),
    ] = None,
    known: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=VALUE[±TOL]",
            help="A value known from elsewhere: held, or with a tolerance a prior, such as "
            "x_leg.length_mm=0.12±0.02 (or +-).",
        ),
    ] = None,
    tolerance: Tolerances = None,
    bound: Annotated[
        list[str] | None,
        typer.Option(
            metavar="GLOB=LOW:HIGH", help="Bounds, such as 'x_slide.offset_mm=-2:2'; open: '=-2:'."
        ),
    ] = None,
    base: Annotated[
        bool,
        typer.Option(
            "--base",
            help="Base parameters, without any prior: of what cannot be told apart one stays.",
        ),
    ] = False,
    loss: Annotated[
        str,
        typer.Option(
            metavar="squares|huber",
            help="What residuals cost; with huber single wrong readings pull less.",
        ),
    ] = "squares",
    profile: Annotated[
        list[str] | None,
        typer.Option(
            metavar="GLOBS", help="Profile-likelihood intervals of these parameters, slowly."
        ),
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="Folder for calibration.json; made if need be.")
    ] = None,
    json: Json = False,
    all_rows: AllRows = False,
) -> None:
    """Identify the errors of a machine from a session of readings."""
    from orthocal.documents import require_writable
    from orthocal.identification.calibrate import calibrate as run
    from orthocal.identification.loss import Loss
    from orthocal.identification.nlp import SolverOptions
    from orthocal.identification.selection import read_bounds, read_known, read_tolerances
    from orthocal.measurement.session_file import load_session

    if out is not None:
        require_writable(out)
    loaded = load_session(session)
    parameters = loaded.robot.parameters
    result = run(
        loaded,
        model=model,
        free=_globs(free),
        prior=prior,
        known=read_known(known or [], parameters, where="--known"),
        tolerances=read_tolerances(tolerance or [], parameters, where="--tolerance"),
        bounds=read_bounds(bound or [], parameters, where="--bound"),
        base=base,
        profile=_globs(profile),
        options=SolverOptions(loss=Loss(loss)),  # type: ignore[arg-type] # checked there
    )
    if json:
        _out(result.to_json().rstrip("\n"))
    else:
        _show(result, all_rows=all_rows)
    if out is not None:
        _note(f"Wrote {result.save(out / 'calibration.json')}")


@app.command()
def validate(
    calibration: CalibrationPath,
    session: Annotated[
        Path,
        typer.Argument(
            metavar="NEW_SESSION", help="Taken with the identified offsets in the controller."
        ),
    ],
    json: Json = False,
    all_rows: AllRows = False,
) -> None:
    """Hold a new session against a calibration: is it confirmed?"""
    from orthocal.identification.calibration_file import load_calibration
    from orthocal.measurement.session_file import load_session
    from orthocal.study.validation import validate_calibration

    result = validate_calibration(load_calibration(calibration), load_session(session))
    if json:
        _out(result.to_json().rstrip("\n"))
    else:
        _show(result, all_rows=all_rows)


@app.command()
def forward(
    calibration: CalibrationPath,
    joints: Annotated[
        Path,
        typer.Argument(metavar="JOINTS.csv", help="Columns as the drives, such as x_slide_mm."),
    ],
) -> None:
    """Where the calibrated machine's tool is, for drive coordinates: CSV on stdout, mm.

    Drive coordinates are those of the encoders, without any offset of the controller.
    """
    from orthocal.identification.calibration_file import load_calibration
    from orthocal.measurement.table import (
        TOOL_COLUMNS,
        closures_named_by_row,
        format_table,
        read_joints,
    )

    result = load_calibration(calibration)
    names, values = read_joints(joints, result.robot)
    with closures_named_by_row():
        points = result.forward(values, names=names)
    _out(format_table(TOOL_COLUMNS, points))


@app.command()
def inverse(
    calibration: CalibrationPath,
    targets: Annotated[
        Path,
        typer.Argument(metavar="TARGETS.csv", help="Columns of the tool: x_mm, y_mm, z_mm."),
    ],
) -> None:
    """Drive coordinates that bring the calibrated machine's tool to points: CSV on stdout.

    Drive coordinates are those of the encoders, without any offset of the controller.
    """
    from orthocal.identification.calibration_file import load_calibration
    from orthocal.measurement.table import (
        closures_named_by_row,
        drive_columns,
        format_table,
        read_points,
    )

    result = load_calibration(calibration)
    names, points = read_points(targets, result.robot)
    with closures_named_by_row():
        drives = result.inverse(points, names=names)
    _out(format_table(drive_columns(result.robot), drives))


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
    from orthocal.documents import exists, require_writable
    from orthocal.identification.selection import read_tolerances
    from orthocal.measurement.session_file import load_plan, write_session
    from orthocal.measurement.synthetic import (
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
    _note(f"Wrote {path}, {len(simulated.session.readings)} simulated readings, and truth.yaml")


def _globs(texts: list[str] | None) -> list[str]:
    """Globs of repeated options, each with commas between."""
    return [glob.strip() for text in texts or [] for glob in text.split(",") if glob.strip()]


def _show(result: Calibration | Validation, *, all_rows: bool) -> None:
    """Print a summary: in colour and as wide as the terminal, or plain where there is none."""
    from orthocal.output.summary import print_summary, summarize

    if sys.stdout.isatty():
        print_summary(result, all_rows=all_rows)
    else:
        sys.stdout.write(summarize(result, all_rows=all_rows))


def _out(text: str) -> None:
    sys.stdout.write(text + "\n")


def _note(text: str) -> None:
    sys.stderr.write(text + "\n")


if __name__ == "__main__":
    main()
