"""Rule for existing files that commands may overwrite.

Results that orthocal wrote are replaced. With --force only, other files are overwritten, those of a
machine or a session, which users edit and fill in, and other lines for a controller, which record
what was entered. Measured readings are never overwritten, even if their session cannot be loaded.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from orthocal.cli.printing import put_note
from orthocal.errors import OrthocalError, SessionError
from orthocal.io.files import exists, read_file, require_writable, require_writable_file

if TYPE_CHECKING:
    from orthocal.session.session import Session

SIMULATED = "Simulated"
"""First word of the source of a simulated session."""

WRITTEN = "Written by orthocal."
"""Mark of an exported file."""

COMMENTS = {
    **dict.fromkeys((".yaml", ".ini", ".cfg"), "# {}"),
    **dict.fromkeys((".gcode", ".g"), "; {}"),
    **dict.fromkeys((".c", ".h"), "/* {} */"),
    **dict.fromkeys((".md", ".urdf"), "<!-- {} -->"),
}
"""Forms of a comment by the suffix of a file."""

UNMARKED = (".csv", ".comp", ".parquet", ".svg")
"""Suffixes of tables and plots, which contain no mark."""

_MARKS = re.compile(
    rb"Written by orthocal|Corrected by orthocal|\(orthocal: |"
    rb'"schema": "orthocal/|<title>(Calibration of|Measuring sheet:) '
)
"""Marks of the files that orthocal writes."""

READINGS = "readings.csv"
"""Table of readings that commands write beside a session.yaml."""

_READING_COLUMNS = ("reading", "x_mm", "y_mm", "z_mm")
"""Beginnings of the headings of readings and measured points."""

_NUMBER = re.compile(r'[\s"\']*[-+\u2212]?[.,]?\d')
"""Beginning of a number in a cell."""

_SEARCHED_BYTES = 4096
"""Number of bytes at the beginning and at the end of a file in which its mark is searched."""


def require_new_session(
    directory: Path,
    names: Iterable[str],
    *,
    force: bool,
    error: type[OrthocalError] = SessionError,
) -> None:
    """Refuse to overwrite files that users edit or fill in; measured readings even with --force.

    Args:
        directory: The directory; it need not exist.
        names: Names of the files.
        force: Whether to overwrite all files except measured readings.
        error: Kind of error to raise.

    Raises:
        OrthocalError: If the directory is not writable, or of kind `error`, if a file exists.
        SessionError: If the session of the directory has readings that were not simulated.
    """
    require_writable(directory)
    for name in names:
        if exists(directory / name) and not force:
            raise error("exists already; --force overwrites it", where=str(directory / name))
    _require_no_readings(directory)


def _require_no_readings(directory: Path) -> None:
    """Refuse to overwrite measured readings.

    Raises:
        SessionError: If the session of the directory has readings that were not simulated. Where it
            cannot be loaded, all readings count as measured.
    """
    from orthocal.assessment.wording import counted
    from orthocal.measurement.files.session_file import load_plan
    from orthocal.session.points import count_readings

    out_of_range: list[SessionError] = []
    table = directory / READINGS
    try:
        session = load_plan(directory, wrong=out_of_range)
    except OrthocalError:  # not a valid session
        count, path = 0, None
    else:
        count = count_readings(session, [r for r in session.readings if r.is_read])
        count += len(out_of_range)
        count = 0 if session.source.startswith(SIMULATED) else count
        path = session.readings_path
    named = path is not None and exists(table) and path.samefile(table)
    if not count and not named:  # a table that no valid session names
        count, path = count_numbers(table), table
    if count:
        raise SessionError(
            f"contains {counted(count, 'reading')}, which --force does not overwrite; move "
            f"{'it' if count == 1 else 'them'} first",
            where=str(path),
        )


def write_plan(
    session: Session, directory: Path, *, comment: str, files: Mapping[str, str]
) -> Path:
    """Write a planned session, and remove files of an earlier plan that it does not replace.

    Otherwise the programs of other setups would remain beside the new sheet.

    Args:
        session: The plan.
        directory: Its directory, which `require_new_session` allows to overwrite.
        comment: Comment at the top of the session.yaml.
        files: Texts of the other files by name.

    Returns:
        Path of the session.yaml.
    """
    from orthocal.measurement.files.write_session import write_session

    path = write_session(session, directory, comment=comment, extra=files, blank=True)
    others = [directory / "sheet.html", directory / "plan.json"]
    others += [p for ending in ("ngc", "txt") for p in directory.glob(f"[0-9]*-*.{ending}")]
    old = sorted(p for p in others if p.name not in files and exists(p) and _is_marked(p))
    old += [p for p in (q.with_suffix(".svg") for q in old if q.suffix == ".json") if exists(p)]
    for file in old:
        with suppress(OSError):
            file.unlink()
    if removed := [p.name for p in old if not exists(p)]:
        put_note(f"Removed from the earlier plan: {', '.join(removed)}")
    return path


def count_numbers(path: Path) -> int:
    """Number of rows with a number among the readings of a table, whatever else is wrong in it.

    Without a column of readings, any number except that of a cycle counts.
    """
    try:
        text = path.read_bytes().decode(errors="replace")
    except OSError:
        return 0
    header, *lines = text.splitlines() or [""]
    separator = max(",;\t", key=header.count)
    names = [name.strip(' "\ufeff').casefold() for name in header.split(separator)]
    columns = [i for i, name in enumerate(names) if name.startswith(_READING_COLUMNS)]
    if not columns:
        columns = [i for i, name in enumerate(names) if name != "cycle"]
    rows = (line.split(separator) for line in lines)
    return sum(any(_NUMBER.match(c) for i, c in enumerate(row) if i in columns) for row in rows)


def require_replaceable_results(directory: Path, files: Mapping[str, str], *, force: bool) -> None:
    """Refuse to overwrite files that orthocal did not write.

    A table or a plot has no mark. It counts as written by orthocal if a file beside it has a mark,
    or if it has the header of the new table.

    Args:
        directory: The directory; it need not exist.
        files: Texts of the new files by name; they are needed for tables only.
        force: Whether to overwrite any file.

    Raises:
        OrthocalError: If the directory is not writable, or contains a file that orthocal did not
            write.
    """
    require_writable(directory, files)
    existing = {directory / n: text for n, text in files.items() if exists(directory / n)}
    marked = {path for path in existing if _is_marked(path)}
    for path, text in existing.items():
        unmarked = path.suffix in UNMARKED and (marked or _has_header(path, text))
        if not (force or path in marked or unmarked):
            raise _refusal(path)


def require_same_text(directory: Path, files: Mapping[str, str]) -> None:
    """Refuse to replace lines for a controller by others: they record what was entered.

    Args:
        directory: The directory; it need not exist.
        files: Texts of the new files by name.

    Raises:
        OrthocalError: If an existing file is not empty and differs from the new one.
    """
    for name, text in files.items():
        path = directory / name
        if exists(path) and read_file(path, error=OrthocalError) not in (b"", text.encode()):
            raise OrthocalError(
                "contains other lines, which record what was entered in the controller; choose "
                "another directory, or overwrite it by --force",
                where=str(path),
            )


def require_replaceable_file(path: Path, *, force: bool, kinds: tuple[str, ...] = ()) -> None:
    """Refuse to overwrite a file that orthocal did not write.

    Args:
        path: The file.
        force: Whether to overwrite any file.
        kinds: Allowed suffixes; any suffix if empty.

    Raises:
        OrthocalError: If the file cannot be written, or orthocal did not write it.
    """
    require_writable_file(path, kinds=kinds)
    if exists(path) and not force and not _is_marked(path):
        raise _refusal(path)


def mark_written(files: Mapping[str, str]) -> dict[str, str]:
    """Texts of files with a mark in the last line, if the kind of file has comments."""
    return {
        name: text if WRITTEN in text[-_SEARCHED_BYTES:] else text + _comment(name)
        for name, text in files.items()
    }


def _comment(name: str) -> str:
    form = COMMENTS.get(Path(name).suffix)
    return "" if form is None else form.format(WRITTEN) + "\n"


def _refusal(path: Path) -> OrthocalError:
    return OrthocalError(
        "exists, and orthocal did not write it; --force overwrites it", where=str(path)
    )


def _is_marked(path: Path) -> bool:
    """True for an empty file, and for a file with a mark of orthocal at its beginning or end."""
    try:
        with path.open("rb") as file:
            size = file.seek(0, os.SEEK_END)
            file.seek(0)
            beginning = file.read(_SEARCHED_BYTES)
            file.seek(max(0, size - _SEARCHED_BYTES))
            return not size or bool(_MARKS.search(beginning) or _MARKS.search(file.read()))
    except OSError:
        return False


def _has_header(path: Path, text: str) -> bool:
    """True for a table that has the same header as a text."""
    header = text.partition("\n")[0].encode()
    try:
        with path.open("rb") as file:
            return bool(header) and file.readline(_SEARCHED_BYTES).rstrip() == header
    except OSError:
        return False
