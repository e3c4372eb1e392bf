"""The program, and what several of its commands take and do."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from orthocal.errors import ParameterError, SessionError
from orthocal.units import MM

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from orthocal.robot.model import Robot
    from orthocal.session.session import Session

    Array = NDArray[np.float64]

SIMULATED = "Simulated"
"""What the source of a session begins with that was not measured."""

MOST_MM = 1e4
"""Largest coordinate of a box, [mm]."""

FEWEST_DIFFERENT = 4
"""Numbers that differ from each other in sessions that can be told to be the same."""

app = typer.Typer(
    add_completion=False,
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    help="Calibrate Orthoglide-type parallel robots from dial-indicator readings.",
)

SessionPaths = Annotated[
    list[Path],
    typer.Argument(
        metavar="SESSION...",
        help="session.yaml, or the folder that holds it; several are fitted together.",
    ),
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


def load_each_once(paths: Sequence[Path]) -> list[Session]:
    """Sessions; one that is named twice would count twice.

    Raises:
        SessionError: If one is the same as another.
    """
    from orthocal.measurement.files.session_file import load_session

    found: list[Session] = []
    for path in paths:
        session = load_session(path)
        if any(session.sha256 == other.sha256 for other in found):
            raise SessionError(
                "is the same session as one before it; its readings would count twice",
                where=str(path),
            )
        copied = next((other for other in found if _same_readings(session, other)), None)
        if copied is not None:
            raise SessionError(
                f"holds the very readings of {copied.path}: a copy that was not measured anew?",
                where=str(session.readings_path or path),
            )
        found.append(session)
    return found


def _same_readings(one: Session, other: Session) -> bool:
    """Whether two sessions were filled with the same numbers, which no dial shows twice."""
    rows = [
        [(r.setup, r.posture, r.minus, r.cycle, r.value) for r in s.readings] for s in (one, other)
    ]
    return rows[0] == rows[1] and len({r[-1] for r in rows[0]}) >= FEWEST_DIFFERENT


def split_globs(texts: list[str] | None) -> list[str]:
    """Globs of repeated options, each with commas between."""
    return [glob.strip() for text in texts or [] for glob in text.split(",") if glob.strip()]


def require_no_readings(folder: Path) -> None:
    """Refuse to write over readings that somebody took; a plan can be made again, they cannot.

    Raises:
        SessionError: If there are any.
    """
    from orthocal.errors import OrthocalError
    from orthocal.io.files import exists
    from orthocal.measurement.files.session_file import SESSION, load_rows

    if not exists(folder / SESSION):
        return
    try:
        session, unread = load_rows(folder)
    except OrthocalError:  # what does not load was no session
        return
    count = len(session.readings) - len(unread)
    if count and not session.source.startswith(SIMULATED):
        raise SessionError(
            f"holds {count} readings, which --force does not write over; take them elsewhere first",
            where=str(session.readings_path or folder),
        )


def read_box(text: str, letters: str, *, where: str) -> Array:
    """Box of an option, shape (n, 2), [m].

    Args:
        text: Half the side of a cube, such as 80, or LOW:HIGH for each coordinate or all of them,
            with commas between, in mm.
        letters: Names of the coordinates.
        where: The option, for messages.

    Raises:
        ParameterError: If the text is no box.
    """
    import numpy as np

    from orthocal.io.documents import parse_number

    def number(part: str) -> float:
        return parse_number(part.strip(), where=where, name="it", error=ParameterError)

    rows = []
    for part in text.split(","):
        low, colon, high = part.partition(":")
        ends = (number(low), number(high)) if colon else (-number(low), number(low))
        if not -MOST_MM <= ends[0] < ends[1] <= MOST_MM or (not colon and "," in text):
            raise ParameterError(
                f"found '{part}'; expected half the side of a cube, such as 80, or LOW:HIGH of "
                f"{','.join(letters)}, such as {','.join(['-80:80'] * len(letters))}, in mm",
                where=where,
            )
        rows.append(ends)
    if len(rows) not in (1, len(letters)):
        raise ParameterError(
            f"has {len(rows)} ranges; expected one for all, or one for each of {','.join(letters)}",
            where=where,
        )
    return np.array(rows * (len(letters) if len(rows) == 1 else 1)) * MM


def read_workspace(text: str, robot: Robot, *, where: str = "--workspace-mm") -> Array:
    """Workspace of an option, which the nominal machine must reach, shape (n, 2), [m].

    Raises:
        ParameterError: If the text is no box, or the machine does not reach it.
    """
    from orthocal.kinematics.workspace import coordinate_letters, find_unreached

    box = read_box(text, coordinate_letters(robot), where=where)
    problem = find_unreached(robot, box)
    if problem:
        raise ParameterError(problem, where=where)
    return box


def read_numbers(text: str, option: str, names: Sequence[str]) -> tuple[float, ...]:
    """Numbers of an option, separated by commas.

    Args:
        text: Value of the option.
        option: Name of the option, for messages.
        names: Names of the numbers.

    Raises:
        ParameterError: If the number of values is another one, or a value is not finite.
    """
    from orthocal.io.documents import parse_number

    parts = text.split(",")
    if len(parts) != len(names):
        raise ParameterError(f"found '{text}'; expected {','.join(names)}", where=option)
    return tuple(
        parse_number(part.strip(), where=option, name=name, error=ParameterError)
        for part, name in zip(parts, names, strict=True)
    )


def read_vector(text: str, option: str) -> tuple[float, float, float]:
    """Coordinates X,Y,Z of an option in mm, [m].

    Raises:
        ParameterError: If they are not three finite numbers.
    """
    x, y, z = read_numbers(text, option, "XYZ")
    return (x * MM, y * MM, z * MM)
