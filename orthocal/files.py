"""Files and folders: what is there, and files written whole or not at all."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterable, Mapping
from pathlib import Path

from orthocal.errors import OrthocalError


def is_folder(path: Path) -> bool:
    """Whether there is such a folder; names that no file system takes are none."""
    try:
        return path.is_dir()
    except (OSError, ValueError):
        return False


def exists(path: Path) -> bool:
    """Whether there is such a file or folder; names that no file system takes are none."""
    try:
        return path.exists()
    except (OSError, ValueError):
        return False


def require_writable(folder: Path, names: Iterable[str] = ()) -> None:
    """Refuse a folder to be written to later that cannot be one: before the work is done.

    Args:
        folder: The folder.
        names: Of the files that will be written into it.

    Raises:
        OrthocalError: If it is a file, or has a name that no file system takes, or if there is a
            folder with the name of one of the files.
    """
    try:
        if folder.exists() and not folder.is_dir():
            raise OrthocalError("is a file; expected a folder", where=str(folder))
    except OSError as e:
        raise OrthocalError(f"cannot be written: {e.strerror}", where=str(folder)) from None
    for name in names:
        if is_folder(folder / name):
            raise OrthocalError("is a folder; expected a file", where=str(folder / name))


def require_writable_file(path: Path, *, kinds: tuple[str, ...] = ()) -> None:
    """Refuse a file to be written later that cannot be one: before the work is done.

    Args:
        path: The file.
        kinds: What its name may end with; anything if empty.

    Raises:
        OrthocalError: If it is a folder, its folder cannot be one, or its name ends otherwise.
    """
    if kinds and path.suffix.lower() not in kinds and not is_folder(path):
        raise OrthocalError(f"expected a name that ends with {kinds[0]}", where=str(path))
    if is_folder(path):
        raise OrthocalError("is a folder; expected a file", where=str(path))
    require_writable(path.parent)


def write_file(path: Path, content: str | bytes) -> None:
    """Write a file whole or not at all: beside it first, then renamed.

    Raises:
        OrthocalError: If it cannot be written.
    """
    require_writable_file(path)
    write_files(path.parent, {path.name: content})


def write_files(folder: Path, files: Mapping[str, str | bytes]) -> None:
    """Write several files of one folder, all or none; the folder is made if need be.

    Args:
        folder: Where to.
        files: Name to text, which is written as UTF-8, or bytes.

    Raises:
        OrthocalError: If the folder cannot be made or written to.
    """
    require_writable(folder, files)
    pending: list[tuple[str, Path]] = []
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, content in files.items():
            handle, temporary = tempfile.mkstemp(dir=folder, prefix=f".{name}.")
            pending.append((temporary, folder / name))
            with os.fdopen(handle, "wb") as stream:
                stream.write(content.encode() if isinstance(content, str) else content)
            os.chmod(temporary, 0o644)
        for temporary, final in pending:
            os.replace(temporary, final)
    except FileExistsError:
        raise OrthocalError("is a file; expected a folder", where=str(folder)) from None
    except OSError as e:
        raise OrthocalError(f"cannot be written: {e.strerror}", where=str(folder)) from None
    finally:
        for temporary, _ in pending:
            Path(temporary).unlink(missing_ok=True)
