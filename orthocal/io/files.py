"""Files and directories: bounded reading, atomic writing."""

from __future__ import annotations

import errno
import os
import re
import stat
from codecs import getincrementaldecoder
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext, suppress
from io import IncrementalNewlineDecoder
from itertools import chain
from pathlib import Path
from typing import BinaryIO

from orthocal.errors import OrthocalError, OutputError
from orthocal.runtime.interrupts import postponed_interrupt, raised_interrupt
from orthocal.text import control_character, printable

LARGEST_FILE = 64 * 2**20
"""Largest size of a file, [bytes]."""

BLOCK_SIZE = 2**16
"""Size of a block that is read at once, [bytes]."""

_READ_FLAGS = (
    os.O_RDONLY
    | getattr(os, "O_BINARY", 0)
    | getattr(os, "O_NOCTTY", 0)
    | getattr(os, "O_NONBLOCK", 0)  # opening a pipe without a writer would block
)

_WRITE_FLAGS = os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0)

_NAME_ERRORS = frozenset(
    {errno.ENAMETOOLONG, errno.ENOTDIR, errno.ELOOP, errno.EILSEQ, errno.EINVAL}
)
"""Errors caused by the name, not by space or permission."""

_LEFTOVER = re.compile(r"\.orthocal-(\d+)-[0-9a-f]{16}\.tmp")


def read_file(
    path: Path, *, error: type[OrthocalError] = OrthocalError, largest: int = LARGEST_FILE
) -> bytes:
    """Content of a regular file of limited size.

    Args:
        path: The file.
        error: Kind of error to raise.
        largest: Largest size, [bytes].

    Raises:
        OrthocalError: Of kind `error`, if the file is missing, not regular, or too large.
    """
    try:
        with open(_open_regular(path, error, largest), "rb") as stream:
            content = stream.read(largest + 1)
    except OSError as e:
        raise error(f"cannot be read: {e.strerror}", where=str(path)) from None
    if content is None:
        raise error("cannot be read: it is not ready", where=str(path))
    if len(content) > largest:  # some special files have no size
        raise error(f"has more; expected at most {largest / 2**20:g} MiB", where=str(path))
    return content


def read_parts(
    path: Path | BinaryIO, *, longest: int, name: str, error: type[OrthocalError] = OrthocalError
) -> Iterator[bytes]:
    """Lines of a file of any size with their line ends; long lines are split into parts.

    Args:
        path: A regular file, or an open stream.
        longest: Largest length of a part, [bytes].
        name: Name for messages.
        error: Kind of error to raise.

    Raises:
        OrthocalError: Of kind `error`, if the file is missing, not regular, or cannot be read.
    """
    source = open(_open_regular(path, error), "rb") if isinstance(path, Path) else nullcontext(path)
    with source as stream:
        try:
            while part := stream.readline(longest):
                yield part
        except OSError as e:
            raise error(f"cannot be read: {e.strerror}", where=name) from None


def read_lines(
    path: Path | BinaryIO, *, longest: int, name: str, error: type[OrthocalError] = OrthocalError
) -> Iterator[str]:
    """Lines of a UTF-8 text of any size; each line ends with a newline character.

    Args:
        path: A regular file, or an open stream.
        longest: Largest length of a line, [characters].
        name: Name for messages.
        error: Kind of error to raise.

    Raises:
        OrthocalError: Of kind `error`, if the file cannot be read or is not UTF-8.
    """
    decoder = getincrementaldecoder("utf-8-sig")()
    newlines = IncrementalNewlineDecoder(decoder, translate=True)
    count, number, pending = 0, 0, ""
    parts = chain(read_parts(path, longest=BLOCK_SIZE, name=name, error=error), [b""])
    for part in parts:
        undecoded = len(decoder.getstate()[0])
        try:
            pending += newlines.decode(part, final=not part)
        except UnicodeDecodeError as e:
            byte = count - undecoded + e.start
            raise error(f"is not UTF-8 text (byte {byte})", where=name) from None
        count += len(part)
        *lines, pending = pending.split("\n")
        for line in lines:
            number += 1
            yield f"{line}\n"
        if len(pending) > longest:
            raise error(
                f"has a line of more than {longest} characters", where=f"{name}:{number + 1}"
            )
    if pending:
        yield pending


def require_file(path: Path, *, error: type[OrthocalError] = OrthocalError) -> None:
    """Check a file that other code will read.

    Raises:
        OrthocalError: Of kind `error`, if the file is missing, not regular, or too large.
    """
    os.close(_open_regular(path, error, LARGEST_FILE))


def _open_regular(path: Path, error: type[OrthocalError], largest: int | None = None) -> int:
    """Descriptor of a regular file; the opened file is checked, not its name."""
    try:
        descriptor = os.open(path, _READ_FLAGS)
        status = os.fstat(descriptor)
    except FileNotFoundError:
        raise error("there is no such file", where=str(path)) from None
    except ValueError:
        raise error("contains a character that file names cannot have", where=str(path)) from None
    except OSError as e:
        raise error(f"cannot be read: {e.strerror}", where=str(path)) from None
    if not stat.S_ISREG(status.st_mode):
        os.close(descriptor)
        kind = "a directory" if stat.S_ISDIR(status.st_mode) else "a device, a pipe or a socket"
        raise error(f"is {kind}; expected a file", where=str(path))
    if largest is not None and status.st_size > largest:
        os.close(descriptor)
        raise error(
            f"has {status.st_size / 2**20:.0f} MiB; expected at most {largest / 2**20:g} MiB",
            where=str(path),
        )
    return descriptor


@contextmanager
def content_withheld_outside(directory: Path, *files: Path) -> Iterator[None]:
    """Withhold the text of errors about files outside the directory of the naming document.

    A document from an untrusted source may name any file of this machine, directly or by a symbolic
    link. A message about such a file contains its name and the line, but none of its content.

    Args:
        directory: Directory of the document.
        files: Files that the code inside the block reads because the document names them.

    Raises:
        OrthocalError: If the code inside the block raises one about such a file; of the same kind.
    """
    root = os.path.realpath(directory)
    outside = [f for f in files if not Path(os.path.realpath(f)).is_relative_to(root)]
    try:
        yield
    except OrthocalError as e:
        for file in outside:
            place = re.match(re.escape(printable(str(file))) + r"(:\d+)?", e.where or "")
            if place:
                raise type(e)(
                    "cannot be used. Its content is not shown: the file is outside the directory "
                    f"'{directory}'",
                    where=place[0],
                ) from None
        raise


def require_plain_name(path: Path, *, error: type[OrthocalError] = OrthocalError) -> None:
    """Refuse a path that cannot be written into a document.

    Raises:
        OrthocalError: Of kind `error`, for control characters and bytes that are not UTF-8.
    """
    character = control_character(str(path))
    if character:
        raise error(
            f"the path contains '{character}', which documents cannot contain; rename the file or "
            "directory",
            where=str(path),
        )


is_folder, exists = os.path.isdir, os.path.exists
"""Tests of a path that are False for invalid names; the methods of Path may raise errors."""


def require_writable(folder: Path, names: Iterable[str] = ()) -> None:
    """Check, before the work is done, that files can be written to a directory.

    A temporary file is created there, or in the nearest existing parent, and removed.

    Args:
        folder: The directory; it need not exist.
        names: Names of the files that will be written.

    Raises:
        OrthocalError: If the directory is a file or has an invalid name, or if one of the files
            exists and is not a regular file.
        OutputError: If the directory is not writable.
    """
    try:
        for name in names:
            _require_replaceable(folder / name)
        if folder.exists() and not folder.is_dir():
            raise OrthocalError("is a file; expected a directory", where=str(folder))
        existing = next((f for f in (folder, *folder.parents) if f.exists()), folder)
        if not existing.is_dir():
            raise OrthocalError("is a file; expected a directory", where=str(existing))
        probe = existing / _temporary_name()
        os.close(os.open(probe, _WRITE_FLAGS, 0o600))
        probe.unlink()
    except (OSError, ValueError) as e:
        raise _refusal(e, folder) from None


def require_writable_file(path: Path, *, kinds: tuple[str, ...] = ()) -> None:
    """Check, before the work is done, that a file can be written.

    Args:
        path: The file.
        kinds: Allowed suffixes; any suffix if empty.

    Raises:
        OrthocalError: If the path is a directory, or its suffix or parent is invalid.
        OutputError: If the file cannot be written.
    """
    if kinds and path.suffix.lower() not in kinds and not is_folder(path):
        raise OrthocalError(f"expected a name that ends with {kinds[0]}", where=str(path))
    try:
        _require_replaceable(path)
        folder = _behind_links(path).parent
    except (OSError, ValueError) as e:
        raise _refusal(e, path) from None
    require_writable(folder)


def _require_replaceable(path: Path) -> None:
    """Refuse to replace anything but a writable regular file."""
    target = _behind_links(path)
    try:
        mode = os.stat(target).st_mode
    except (FileNotFoundError, NotADirectoryError):
        return
    if stat.S_ISDIR(mode):
        raise OrthocalError("is a directory; expected a file", where=str(path))
    if not stat.S_ISREG(mode):
        raise OrthocalError("is a device, a pipe or a socket; expected a file", where=str(path))
    if not os.access(target, os.W_OK):
        raise OutputError("is write-protected", where=str(path))


Content = str | bytes | Iterable[bytes]
"""Content of a file: text, which is written as UTF-8, bytes, or a sequence of bytes."""


def require_suffix(path: Path, suffix: str, others: Sequence[str]) -> None:
    """Refuse to write a file whose suffix is that of another kind of file, such as readings.

    Args:
        path: The file.
        suffix: Suffix that is expected, for the message.
        others: Suffixes of other kinds of files.

    Raises:
        OrthocalError: If the suffix is one of them.
    """
    if path.suffix.lower() in others:
        raise OrthocalError(
            f"is another kind of file; expected a name with {suffix}", where=str(path)
        )


def write_file(path: Path, content: Content) -> None:
    """Write a file atomically, by renaming a temporary file beside it.

    Raises:
        OrthocalError: If the path is invalid.
        OutputError: If the file cannot be written.
    """
    require_writable_file(path)
    write_files(path.parent, {path.name: content})


def write_files(folder: Path, files: Mapping[str, Content]) -> None:
    """Write several files of one directory that belong together, all or none.

    All are written to temporary files first. Then Ctrl-C is postponed, the old files except the
    first are moved away, the first is replaced, and the others follow. If the process is killed at
    any time, the remaining files are of one generation. Symbolic links are followed. Existing files
    keep their mode; new files have the default mode of the user.

    Args:
        folder: The directory; created if necessary.
        files: Content by name. The others are useless without the first file.

    Raises:
        OrthocalError: If a path is invalid.
        OutputError: If a file cannot be written.
    """
    require_writable(folder, files)
    try:
        with raised_interrupt():
            _write(folder, files)
    except FileExistsError:
        raise OrthocalError("is a file; expected a directory", where=str(folder)) from None
    except (OSError, ValueError) as e:
        raise _refusal(e, folder) from None


def sync_folder(folder: Path) -> None:
    """Write the entries of a directory to disk, where the file system supports it."""
    with suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def _write(folder: Path, files: Mapping[str, Content]) -> None:
    """Write all files to temporary files, then rename them; temporary files are always removed."""
    staged: dict[Path, Path] = {}
    moved_away: dict[Path, Path] = {}
    created = [f for f in (folder, *folder.parents) if not f.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, content in files.items():
            target = _behind_links(folder / name)
            _clean_up(target.parent)
            staged[target] = target.with_name(_temporary_name())
            data = content.encode() if isinstance(content, str) else content
            _stage(staged[target], [data] if isinstance(data, bytes) else data, like=target)
        with postponed_interrupt():
            _put_in_place(staged, moved_away)
    finally:
        for temporary in (*staged.values(), *moved_away.values()):
            temporary.unlink(missing_ok=True)
        for empty in created:  # succeeds only if nothing was written
            with suppress(OSError):
                empty.rmdir()


def _put_in_place(staged: Mapping[Path, Path], moved_away: dict[Path, Path]) -> None:
    """Rename staged files without ever mixing two generations.

    Args:
        staged: Temporary files by target; the others are useless without the first file.
        moved_away: Temporary names of old files by target; filled by this function.
    """
    first, *others = staged
    try:
        for target in others:
            old = target.with_name(_temporary_name())
            with suppress(FileNotFoundError):
                os.replace(target, old)
                moved_away[target] = old
        os.replace(staged[first], first)
    except OSError:
        for target, old in moved_away.items():
            os.replace(old, target)
        moved_away.clear()
        raise
    for target in others:
        os.replace(staged[target], target)


def _behind_links(path: Path) -> Path:
    """Target of a symbolic link, existing or not; other paths are returned unchanged."""
    return Path(os.path.realpath(path)) if path.is_symlink() else path


def _stage(temporary: Path, parts: Iterable[bytes], *, like: Path) -> None:
    """Write a temporary file with the mode of the file that it will replace."""
    with open(os.open(temporary, _WRITE_FLAGS, 0o666), "wb") as stream:
        with suppress(FileNotFoundError):
            os.chmod(temporary, stat.S_IMODE(os.stat(like).st_mode))
        stream.writelines(parts)
        stream.flush()
        os.fsync(stream.fileno())


def _temporary_name() -> str:
    return f".orthocal-{os.getpid()}-{os.urandom(8).hex()}.tmp"


def _clean_up(folder: Path) -> None:
    """Remove the temporary files of killed processes from a directory, if they may be removed."""
    for entry in os.scandir(folder):
        temporary = _LEFTOVER.fullmatch(entry.name)
        if temporary and not _is_alive(int(temporary[1])):
            with suppress(OSError):  # of another user, in a shared directory
                os.unlink(entry.path)


def _is_alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except OSError:  # the process belongs to another user
        return True
    return True


def _refusal(e: OSError | ValueError, where: Path) -> OrthocalError:
    """Error for a path that is not writable, because of its name or of the file system."""
    if not isinstance(e, OSError):
        return OrthocalError("contains a character that file names cannot have", where=str(where))
    kind = OrthocalError if e.errno in _NAME_ERRORS else OutputError
    return kind(f"cannot be written: {e.strerror}", where=str(where))
