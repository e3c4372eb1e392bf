"""The rule for existing files: what a command may overwrite.

Results that orthocal wrote are replaced. Files of somebody else, and those of a machine or a
session, which people edit and fill in, are overwritten with --force only, and measured readings
never.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Mapping
from pathlib import Path

from orthocal.errors import OrthocalError, SessionError
from orthocal.io.files import exists, require_writable, require_writable_file

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
"""Suffix of a file to a comment in it."""

TABLES = (".csv", ".comp")
"""Suffixes of files without comments, which cannot hold a mark."""

_OWN = re.compile(
    rb"Written by orthocal|Corrected by orthocal|\(orthocal: |"
    rb'"schema": "orthocal/|<title>(Calibration of|Measuring sheet:) '
)
"""Marks of the files that orthocal writes."""

_END = 4096
"""Number of bytes at the beginning and at the end of a file, where its mark is."""


def require_new_session(
    directory: Path,
    names: Iterable[str],
    *,
    force: bool,
    error: type[OrthocalError] = SessionError,
) -> None:
    """Refuse to overwrite files that people edit or fill in; measured readings even with --force.

    Args:
        directory: The directory; it need not exist.
        names: Names of the files.
        force: True to overwrite all but measured readings.
        error: Kind of error to raise.

    Raises:
        OrthocalError: If the directory cannot be written, or of kind `error`, if a file exists.
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
        SessionError: If the session of the directory has readings that were not simulated.
    """
    from orthocal.measurement.files.session_file import SESSION, load_rows

    if not exists(directory / SESSION):
        return
    try:
        session = load_rows(directory)
    except OrthocalError:  # it was not a session
        return
    count = sum(r.is_read for r in session.readings)
    if count and not session.source.startswith(SIMULATED):
        raise SessionError(
            f"contains {count} readings, which --force does not overwrite; move them first",
            where=str(session.readings_path or directory),
        )


def require_own_results(directory: Path, files: Mapping[str, str], *, force: bool) -> None:
    """Refuse to overwrite files that orthocal did not write; its own are replaced.

    A table without a mark is its own beside a file with one, or with the header of the new table.

    Args:
        directory: The directory; it need not exist.
        files: Names and texts of the new files; the texts matter for tables only.
        force: True to overwrite any file.

    Raises:
        OrthocalError: If the directory cannot be written, or contains a file of somebody else.
    """
    require_writable(directory, files)
    there = {directory / n: text for n, text in files.items() if exists(directory / n)}
    marked = {path for path in there if _is_marked(path)}
    for path, text in there.items():
        is_table = path.suffix in TABLES and (marked or _has_header(path, text))
        if not (force or path in marked or is_table):
            raise _refusal(path)


def require_own_file(path: Path, *, force: bool, kinds: tuple[str, ...] = ()) -> None:
    """Refuse to overwrite a file that orthocal did not write.

    Args:
        path: The file.
        force: True to overwrite it all the same.
        kinds: Allowed suffixes; any suffix if empty.

    Raises:
        OrthocalError: If the file cannot be written, or is of somebody else.
    """
    require_writable_file(path, kinds=kinds)
    if exists(path) and not force and not _is_marked(path):
        raise _refusal(path)


def mark_written(files: Mapping[str, str]) -> dict[str, str]:
    """Texts of files with a last line that marks those that can hold a comment."""
    return {
        name: text if WRITTEN in text[-_END:] else text + _comment(name)
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
    """True for a file with a mark of orthocal at its beginning or end; empty files count, too."""
    try:
        with path.open("rb") as file:
            size = file.seek(0, os.SEEK_END)
            file.seek(0)
            head = file.read(_END)
            file.seek(max(0, size - _END))
            return not size or bool(_OWN.search(head) or _OWN.search(file.read()))
    except OSError:
        return False


def _has_header(path: Path, text: str) -> bool:
    """True for a table with the first line of a text."""
    header = text.partition("\n")[0].encode()
    try:
        with path.open("rb") as file:
            return bool(header) and file.readline(_END).rstrip() == header
    except OSError:
        return False
