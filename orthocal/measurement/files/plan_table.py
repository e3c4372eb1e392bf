"""A plan becomes a session: its rows are written down, and its YAML names them."""

from __future__ import annotations

from pathlib import Path

from orthocal.errors import SessionError
from orthocal.io.documents import read_yaml
from orthocal.io.files import exists, read_file
from orthocal.session.session import Session


def add_name_of_rows(session: Session, csv: Path, text: str) -> bytes:
    """The YAML of a plan without readings, with the name of its rows; nothing is written.

    Nothing else changes in it: comments stay.

    Args:
        session: The plan.
        csv: Beside its YAML, to be written.
        text: Of the CSV.

    Raises:
        SessionError: If there is such a file with other rows, or the YAML cannot be added to.
    """
    file = session.path
    if file is None:
        raise SessionError("the plan is from no file")
    if exists(csv) and read_file(csv, error=SessionError) != text.encode():
        raise SessionError(
            f"holds other rows than {file.name} plans, and would be written over; move it away, or "
            f"name it in {file.name} by `readings: {csv.name}`",
            where=str(csv),
        )
    content = read_file(file, error=SessionError)
    added = content.rstrip() + f"\nreadings: {csv.name}\n".encode()
    before = read_yaml(file, error=SessionError, content=content)
    try:
        after = read_yaml(file, error=SessionError, content=added)
    except SessionError:
        after = None
    if after != {**before, "readings": csv.name}:
        raise SessionError(
            f"is missing; add `readings: {csv.name}` to it", where=f"{file}: readings"
        )
    return added
