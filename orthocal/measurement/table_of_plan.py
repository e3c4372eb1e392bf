"""A plan becomes a session: its rows are written down, and its YAML names them."""

from __future__ import annotations

from pathlib import Path

from orthocal.documents import read_yaml
from orthocal.errors import SessionError
from orthocal.files import exists, read_file, write_file
from orthocal.measurement.session import Session


def write_rows_of_plan(session: Session, csv: Path, text: str) -> None:
    """Write the rows of a plan without readings, and then their name into its YAML.

    Nothing else changes in the YAML: comments stay. Killed between, it does the same once more.

    Args:
        session: The plan.
        csv: Beside its YAML.
        text: Of the CSV.

    Raises:
        SessionError: If there is such a file with other rows, or the YAML cannot be added to.
        OutputError: If it cannot be written.
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
    if not exists(csv):
        write_file(csv, text)
    write_file(file, added)
