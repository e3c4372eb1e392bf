"""The command line. The only place that prints, and that turns errors into exit codes.

Imports of anything slow stand inside the commands: help answers at once.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

import orthocal
from orthocal.characters import printable
from orthocal.errors import ClosureError, OrthocalError, ParameterError, SessionError
from orthocal.interrupts import INTERRUPTED, ending_at_interrupt
from orthocal.streams import ReaderGoneError, guarded_streams

if TYPE_CHECKING:
    from orthocal.measurement.session import Session
    from orthocal.output.view.scene import Scene
    from orthocal.study.rows import Chunk

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
AllRows = Annotated[
    bool, typer.Option("--all", help="List every reading, parameter and group, however many.")
]


def main() -> None:
    """Run the command line; no traceback ever reaches a user.

    Exit codes: 0 done, 1 a solve did not converge or an output cannot be written, 2 bad input,
    3 some rows of a table cannot be reached, or what was found is not to be entered, or is not
    confirmed, 70 a bug of ours, 130 Ctrl-C; `compare` has more.
    """
    # small matrices only: more threads would but get in each other's way
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    with guarded_streams(), ending_at_interrupt():
        code = _run()
    sys.exit(code)


def _run() -> int | str | None:
    """Run the command; its exit code."""
    code: int | str | None = 0
    try:
        try:
            app()
        except SystemExit as e:
            code = e.code
        sys.stdout.flush()
    except ReaderGoneError:
        pass
    except OrthocalError as e:
        _note(f"orthocal: {e}")
        code = e.exit_code
    except KeyboardInterrupt:
        code = INTERRUPTED
    except MemoryError:
        _note("orthocal: there is not enough memory for an input of this size")
        code = 1
    except Exception as e:
        if os.environ.get("ORTHOCAL_DEBUG"):
            raise
        _note(
            "orthocal: this is a bug of orthocal, not of your input: "
            f"{printable(f'{type(e).__name__}: {e}')}\n"
            "Set ORTHOCAL_DEBUG=1 to see where, and report it."
        )
        code = 70
    return code


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
    sessions: Annotated[
        list[Path],
        typer.Argument(
            metavar="SESSION...",
            help="session.yaml, or the folder that holds it; several are fitted together.",
        ),
    ],
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
    solver: Annotated[
        str,
        typer.Option(
            metavar="ipopt|eliminated|linearised",
            help="The reference; the same optimum sooner; to first order, as the paper.",
        ),
    ] = "ipopt",
    profile: Annotated[
        list[str] | None,
        typer.Option(
            metavar="GLOBS", help="Profile-likelihood intervals of these parameters, slowly."
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(help="Folder for calibration.json and report.html; made if need be."),
    ] = None,
    json: Json = False,
    details: Annotated[
        bool, typer.Option("--details", help="Print all that is known, not the answer alone.")
    ] = False,
    all_rows: Annotated[
        bool,
        typer.Option(
            "--all", help="--details with every reading, parameter and group, however many."
        ),
    ] = False,
) -> None:
    """Identify the errors of a machine from sessions of readings: what to enter, and whether.

    Exit code 3: what was identified is not to be entered, for the reason that is printed; all
    outputs are written all the same.
    """
    from orthocal.files import require_writable, write_files
    from orthocal.identification.calibrate import calibrate as run
    from orthocal.identification.choice import Choice
    from orthocal.identification.selection import read_bounds, read_known, read_tolerances
    from orthocal.measurement.joining import join_sessions
    from orthocal.output.printed_json import calibration_json
    from orthocal.output.summary import print_summary
    from orthocal.study.findings.calibration import decide

    if out is not None:
        require_writable(out, ("calibration.json", "report.html"))
    loaded = join_sessions(_load_each_once(sessions))
    parameters = loaded.robot.parameters
    result = run(
        loaded,
        Choice(
            model=model,
            free=_globs(free),
            prior=prior,
            known=read_known(known or [], parameters, where="--known"),
            tolerances=read_tolerances(tolerance or [], parameters, where="--tolerance"),
            bounds=read_bounds(bound or [], parameters, where="--bound"),
            base=base,
        ),
        loss=loss,  # type: ignore[arg-type] # checked there
        solver=solver,  # type: ignore[arg-type] # likewise
        profile=_globs(profile),
    )
    if json:
        _out(calibration_json(result).rstrip("\n"))
    else:
        print_summary(result, details=details, all_rows=all_rows)
    if out is not None:
        from orthocal.output.report.page import build_report

        files = {"calibration.json": result.to_json(), "report.html": build_report(result)}
        write_files(out, files)
        _note(f"Wrote {out / 'calibration.json'} and {out / 'report.html'}")
    if code := decide(result).exit_code:
        raise typer.Exit(code)


@app.command()
def compare(
    session: SessionPath,
    models: Annotated[
        str | None,
        typer.Option(metavar="MODELS", help="With commas between; all of the robot's by default."),
    ] = None,
    repeat: Annotated[
        Path | None,
        typer.Option(metavar="SESSION", help="Another session: does what remains repeat?"),
    ] = None,
    tolerance: Tolerances = None,
    json: Json = False,
    all_rows: AllRows = False,
) -> None:
    """Which model do the readings support: offsets, lengths, full, linearised and exact?

    Exit code 0: one is supported, and what it leaves is noise. 3: one is supported, but what it
    leaves is error of the model. 4: none is supported.
    """
    from orthocal.identification.selection import read_tolerances
    from orthocal.measurement.session_file import load_session
    from orthocal.output.summary import print_summary
    from orthocal.study.comparison import compare_models

    loaded = load_session(session)
    result = compare_models(
        loaded,
        models=_globs([models] if models else None),
        tolerances=read_tolerances(tolerance or [], loaded.robot.parameters, where="--tolerance"),
        repeat=None if repeat is None else load_session(repeat),
    )
    if json:
        _out(result.to_json().rstrip("\n"))
    else:
        print_summary(result, all_rows=all_rows)
    raise typer.Exit(result.verdict.exit_code)


@app.command()
def accuracy(
    calibration: CalibrationPath,
    points: Annotated[
        Path | None,
        typer.Argument(metavar="[TARGETS.csv]", help="Columns of the tool: x_mm, y_mm, z_mm."),
    ] = None,
    half_side_mm: Annotated[
        float | None,
        typer.Option(
            min=0.001,
            max=1e5,
            help="Half the side of the cube, without points; else the largest that the machine "
            "reaches, of 60 mm at most.",
        ),
    ] = None,
    json: Json = False,
) -> None:
    """Where the tool really is, and how well that is known: over a cube, or at points.

    With points CSV on stdout: by how much the tool is off each, and one standard deviation of that.
    Exit code 3: some cannot be reached; they are named, and their cells are empty.
    """
    from orthocal.identification.calibration_file import load_calibration
    from orthocal.kinematics.workspace import Workspace, cube
    from orthocal.measurement.table import read_points
    from orthocal.output.accuracy import (
        POINT_COLUMNS,
        accuracy_json,
        format_points,
        print_accuracy,
    )
    from orthocal.study.accuracy import MOST_POINTS, assess_tool
    from orthocal.study.rows import accuracy_rows

    result = load_calibration(calibration)
    names, workspace = None, None
    if points is not None:
        names, given = read_points(points, result.robot)
        if not json:
            _print_rows(POINT_COLUMNS, format_points, accuracy_rows(result, given, names=names))
            return
        if len(given) > MOST_POINTS:
            raise SessionError(
                f"holds {len(given)} points; expected at most {MOST_POINTS} with --json, which "
                "looks at all of them together",
                where=str(points),
            )
        workspace = Workspace.even(given)
    elif half_side_mm is not None:
        workspace = cube(result.robot, half_side=half_side_mm * 1e-3)
    try:
        found = assess_tool(result, workspace, names=names)
    except ClosureError as e:
        if half_side_mm is None:
            raise SessionError(e.reason, where=e.posture) from None
        largest = assess_tool(result).workspace.half_side
        known = "" if largest is None else f"; without this it is ±{largest * 1e3:.3g} mm"
        raise SessionError(
            f"the machine does not reach a cube of ±{half_side_mm:g} mm{known} ({e.reason})",
            where="--half-side-mm",
        ) from None
    if json:
        _out(accuracy_json(result, found).rstrip("\n"))
    else:
        print_accuracy(result, found)


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
    """Hold a new session against a calibration: is it confirmed?

    Exit code 0: it is. 3: it is not, or a further fit would change something.
    """
    from orthocal.identification.calibration_file import load_calibration
    from orthocal.measurement.session_file import load_session
    from orthocal.output.printed_json import validation_json
    from orthocal.output.summary import print_summary
    from orthocal.study.findings.validation import decide_validation
    from orthocal.study.validation import validate_calibration

    result = validate_calibration(load_calibration(calibration), load_session(session))
    if json:
        _out(validation_json(result).rstrip("\n"))
    else:
        print_summary(result, all_rows=all_rows)
    if code := decide_validation(result).exit_code:
        raise typer.Exit(code)


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

    Exit code 3: some rows cannot be reached; they are named, and their cells are empty.
    """
    from orthocal.identification.calibration_file import load_calibration
    from orthocal.measurement.table import TOOL_COLUMNS, format_rows, read_joints
    from orthocal.study.rows import forward_rows

    result = load_calibration(calibration)
    names, values = read_joints(joints, result.robot)
    form = partial(format_rows, TOOL_COLUMNS)
    _print_rows(TOOL_COLUMNS, form, forward_rows(result, values, names=names))


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

    Exit code 3: some rows cannot be reached; they are named, and their cells are empty.
    """
    from orthocal.identification.calibration_file import load_calibration
    from orthocal.measurement.table import drive_columns, format_rows, read_points
    from orthocal.study.rows import inverse_rows

    result = load_calibration(calibration)
    names, points = read_points(targets, result.robot)
    columns = drive_columns(result.robot)
    form = partial(format_rows, columns)
    _print_rows(columns, form, inverse_rows(result, points, names=names))


@app.command()
def report(
    calibration: CalibrationPath,
    out: Annotated[
        Path | None,
        typer.Option(
            help="A page, or a folder that is there; else report.html beside the calibration."
        ),
    ] = None,
) -> None:
    """Write a calibration as one page: what to enter, how far to believe it, and why."""
    from orthocal.files import is_folder, require_writable_file
    from orthocal.identification.calibration_file import load_calibration
    from orthocal.output.report.page import write_report

    result = load_calibration(calibration)
    folder = Path() if result.path is None else result.path.parent
    target = folder if out is None else out
    if is_folder(target):
        target = target / "report.html"
    require_writable_file(target, kinds=(".html", ".htm"))
    _note(f"Wrote {write_report(result, target)}")


@app.command()
def view(
    subject: Annotated[
        str,
        typer.Argument(
            metavar="SESSION|CALIBRATION|ROBOT",
            help="session.yaml, calibration.json, a folder that holds one, or a robot.",
        ),
    ],
    html: Annotated[
        Path | None, typer.Option(help="Write one page that opens without network and server.")
    ] = None,
    png: Annotated[
        Path | None, typer.Option(help="Write a picture, by a Chromium that is installed.")
    ] = None,
    size: Annotated[
        str, typer.Option(metavar="WIDTHxHEIGHT", help="Of the picture, in pixels.")
    ] = "1400x900",
    posture: Annotated[
        str | None,
        typer.Option(help="Stand there, with what was read there; else the whole measurement."),
    ] = None,
    exaggerate: Annotated[
        float | None,
        typer.Option(
            metavar="FACTOR",
            help="How many times its size the machine's deviation is drawn; 1 for true scale.",
        ),
    ] = None,
    show: Annotated[
        str | None,
        typer.Option(metavar="readings|tool|all", help="What of a calibration is shown at first."),
    ] = None,
    port: Annotated[
        int | None, typer.Option(min=1, max=65535, help="Where to listen; else one that is free.")
    ] = None,
    browse: Annotated[bool, typer.Option("--open", help="Open the browser, too.")] = False,
) -> None:
    """Look at a machine, its measurement and its calibration in 3-D.

    Without --html and --png on a server that only this machine reaches, until Ctrl-C.
    """
    from orthocal.files import require_writable_file
    from orthocal.output.subject import load_subject
    from orthocal.output.view.browser import find_chromium, parse_size, take_picture
    from orthocal.output.view.drawing import draw_scene

    width, height = parse_size(size)
    for path, kinds in ((html, (".html", ".htm")), (png, (".png",))):
        if path is not None:
            require_writable_file(path, kinds=kinds)
    if png is not None:
        find_chromium()
    scene = draw_scene(load_subject(subject), posture=posture, exaggeration=exaggerate, show=show)
    if html is not None:
        _note(f"Wrote {scene.save(html)}")
    if png is not None:
        _note(f"Wrote {take_picture(scene.to_html(), png, width=width, height=height)}")
    if html is None and png is None:
        _serve(scene, port, browse)


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
    from orthocal.files import exists, require_writable
    from orthocal.identification.selection import read_tolerances
    from orthocal.measurement.session_file import load_plan
    from orthocal.measurement.session_output import write_session
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


def _load_each_once(paths: Sequence[Path]) -> list[Session]:
    """Sessions; one that is named twice would count twice.

    Raises:
        SessionError: If one is the same as another.
    """
    from orthocal.measurement.session_file import load_session

    found: list[Session] = []
    for path in paths:
        session = load_session(path)
        if any(session.sha256 == other.sha256 for other in found):
            raise SessionError(
                "is the same session as one before it; its readings would count twice",
                where=str(path),
            )
        found.append(session)
    return found


def _globs(texts: list[str] | None) -> list[str]:
    """Globs of repeated options, each with commas between."""
    return [glob.strip() for text in texts or [] for glob in text.split(",") if glob.strip()]


def _print_rows(
    columns: Iterable[str], form: Callable[[Any], str], chunks: Iterable[Chunk]
) -> None:
    """Print a table as it is evaluated; rows that are refused are named, and their cells empty.

    Raises:
        SessionError: If the machine can be at none of the rows.
        typer.Exit: With code 3 if it cannot be at some.
    """
    refused: list[str] = []
    count, begun, rest = 0, False, ""
    first: tuple[str, str] | None = None
    for chunk in chunks:
        count += len(chunk.refused)
        for e in chunk.refused.values():
            first = first or (e.posture, e.reason)
            refused.append(f"orthocal: {e.posture}: {e.reason}")
        rest += form(chunk.values)
        if not begun and len(chunk.refused) == len(chunk.values):
            continue  # there may be none to be served at all
        text, rest = rest if begun else printable(",".join(columns)) + "\n" + rest, ""
        begun = True
        _out(text.removesuffix("\n"))
        for line in refused:
            _note(line)
        refused.clear()
    if first is not None and not begun:
        raise SessionError(first[1], where=first[0])
    if count:
        _note(f"orthocal: {count} of the rows cannot be reached; their cells are empty")
        raise typer.Exit(3)


def _serve(scene: Scene, port: int | None, browse: bool) -> None:
    """Show a scene until Ctrl-C."""
    from orthocal.output.view.live import LiveScene

    with LiveScene(scene, port=port) as live:
        _out(live.url)
        _note("Open this in a browser on this machine; Ctrl-C ends.")
        if browse:
            import webbrowser

            webbrowser.open(live.url)
        live.wait()


def _out(text: str) -> None:
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


def _note(text: str) -> None:
    sys.stderr.write(printable(text, keep="\n") + "\n")


if __name__ == "__main__":
    main()
