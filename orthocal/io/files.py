"""Files and folders: read within bounds, written whole or not at all."""

from __future__ import annotations

import errno
import os
import re
import secrets
import stat
from codecs import getincrementaldecoder
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from io import IncrementalNewlineDecoder
from itertools import chain
from pathlib import Path
from typing import BinaryIO

from orthocal.errors import OrthocalError, OutputError
from orthocal.runtime.interrupts import postponed_interrupt, raised_interrupt
from orthocal.text import control_character, printable

LARGEST_FILE = 64 * 2**20
"""Files above this size are refused, [bytes]."""

PART = 2**16
"""Bytes that are read together."""

_READ_FLAGS = (
    os.O_RDONLY
    | getattr(os, "O_BINARY", 0)
    | getattr(os, "O_CLOEXEC", 0)
    | getattr(os, "O_NOCTTY", 0)
    | getattr(os, "O_NONBLOCK", 0)  # opening a pipe that nobody writes to would wait for ever
)

_WRITE_FLAGS = os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0)

_NO_NAME = frozenset({errno.ENAMETOOLONG, errno.ENOTDIR, errno.ELOOP, errno.EILSEQ, errno.EINVAL})
"""What is wrong with a name itself, whatever there is room and right for."""

_LEFTOVER = re.compile(r"\.orthocal-(\d+)-[0-9a-f]{16}\.tmp")


def read_file(
    path: Path, *, error: type[OrthocalError] = OrthocalError, largest: int = LARGEST_FILE
) -> bytes:
    """All of a regular file: no device, no pipe, and not more than can be meant.

    Args:
        path: The file.
        error: Kind of error to raise.
        largest: Size above which it is refused, [bytes].

    Raises:
        OrthocalError: Of the kind given, if it is missing, no regular file, or too large.
    """
    descriptor = _open_regular(path, error)
    try:
        with open(descriptor, "rb", closefd=False) as stream:
            size = os.fstat(descriptor).st_size
            content = b"" if size > largest else stream.read(largest + 1)
            if content is None:
                raise error("cannot be read: it is not ready", where=str(path))
    except OSError as e:
        raise error(f"cannot be read: {e.strerror}", where=str(path)) from None
    finally:
        os.close(descriptor)
    if max(size, len(content)) > largest:
        found = f"{size / 2**20:.0f} MiB" if size > largest else "more"
        raise error(f"has {found}; expected at most {largest / 2**20:g} MiB", where=str(path))
    return content


def read_parts(
    path: Path | BinaryIO, *, longest: int, name: str, error: type[OrthocalError] = OrthocalError
) -> Iterator[bytes]:
    """Lines of a file of any size, one at a time, each with what ends it.

    Args:
        path: A regular file, or a stream that is open.
        longest: Bytes of a line above which it comes in parts.
        name: For messages.
        error: Kind of error to raise.

    Raises:
        OrthocalError: Of the kind given, if it is missing, no regular file, or cannot be read.
    """
    stream = open(_open_regular(path, error), "rb") if isinstance(path, Path) else path
    try:
        while part := stream.readline(longest):
            yield part
    except OSError as e:
        raise error(f"cannot be read: {e.strerror}", where=name) from None
    finally:
        if isinstance(path, Path):
            stream.close()


def read_lines(
    path: Path | BinaryIO, *, longest: int, name: str, error: type[OrthocalError] = OrthocalError
) -> Iterator[str]:
    """Lines of a UTF-8 text of any size, one at a time; all ends of lines are newlines.

    Args:
        path: A regular file, or a stream that is open.
        longest: Characters above which a line is refused.
        name: For messages.
        error: Kind of error to raise.

    Raises:
        OrthocalError: Of the kind given, if it cannot be read, or is not UTF-8.
    """
    decoder = getincrementaldecoder("utf-8-sig")()
    newlines = IncrementalNewlineDecoder(decoder, translate=True)
    count, number, rest = 0, 0, ""
    parts = chain(read_parts(path, longest=PART, name=name, error=error), [b""])
    for part in parts:
        kept = len(decoder.getstate()[0])
        try:
            rest += newlines.decode(part, final=not part)
        except UnicodeDecodeError as e:
            byte = count - kept + e.start
            raise error(f"is not UTF-8 text (byte {byte})", where=name) from None
        count += len(part)
        *lines, rest = rest.split("\n")
        for line in lines:
            number += 1
            yield f"{line}\n"
        if len(rest) > longest:
            raise error(
                f"has a line of more than {longest} characters", where=f"{name}:{number + 1}"
            )
    if rest:
        yield rest


def require_file(
    path: Path, *, error: type[OrthocalError] = OrthocalError, largest: int = LARGEST_FILE
) -> None:
    """Refuse what `read_file` would refuse, for a file that other code will read.

    Raises:
        OrthocalError: Of the kind given, as `read_file`.
    """
    descriptor = _open_regular(path, error)
    size = os.fstat(descriptor).st_size
    os.close(descriptor)
    if size > largest:
        raise error(
            f"has {size / 2**20:.0f} MiB; expected at most {largest / 2**20:g} MiB",
            where=str(path),
        )


def _open_regular(path: Path, error: type[OrthocalError]) -> int:
    """Descriptor of a regular file: what was opened is what is looked at."""
    try:
        descriptor = os.open(path, _READ_FLAGS)
        mode = os.fstat(descriptor).st_mode
    except FileNotFoundError:
        raise error("there is no such file", where=str(path)) from None
    except ValueError:
        raise error("holds a character that no name of a file can", where=str(path)) from None
    except OSError as e:
        raise error(f"cannot be read: {e.strerror}", where=str(path)) from None
    if not stat.S_ISREG(mode):
        os.close(descriptor)
        found = "a folder" if stat.S_ISDIR(mode) else "a device, a pipe or a socket"
        raise error(f"is {found}; expected a file", where=str(path))
    return descriptor


@contextmanager
def content_withheld_outside(directory: Path, *files: Path) -> Iterator[None]:
    """Withhold the text of errors about files that a document names outside its own directory.

    A document from a stranger may name any file of this machine, directly or by a symbolic link.
    Messages about such a file name it and the line, and quote nothing of what it holds.

    Args:
        directory: Directory of the document.
        files: Files that the code inside the block reads because the document names them.

    Raises:
        OrthocalError: Of the same kind as inside the block, without its text.
    """
    root = os.path.realpath(directory)
    outside = [f for f in files if not Path(os.path.realpath(f)).is_relative_to(root)]
    try:
        yield
    except OrthocalError as e:
        for file in outside:
            found = re.match(re.escape(printable(str(file))) + r"(:\d+)?", e.where or "")
            if found:
                raise type(e)(
                    "cannot be used. Its content is not shown: the file is outside the directory "
                    f"'{directory}'",
                    where=found[0],
                ) from None
        raise


def require_plain_name(path: Path, *, error: type[OrthocalError] = OrthocalError) -> None:
    """Refuse a path that a document cannot name: it is written into what is made from it.

    Raises:
        OrthocalError: Of the kind given, for control characters and bytes that are no UTF-8.
    """
    found = control_character(str(path))
    if found:
        raise error(
            f"the path holds '{found}', which no document can name; rename the file or folder",
            where=str(path),
        )


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

    A file is made in it, or in the folder that it will be made in, and taken away again.

    Args:
        folder: The folder.
        names: Of the files that will be written into it.

    Raises:
        OrthocalError: If it is a file, or has a name that no file system takes, or if there is
            something else than a file with the name of one of the files.
        OutputError: If nothing can be written there.
    """
    try:
        for name in names:
            _require_replaceable(folder / name)
        if folder.exists() and not folder.is_dir():
            raise OrthocalError("is a file; expected a folder", where=str(folder))
        there = next((f for f in (folder, *folder.parents) if f.exists()), folder)
        if not there.is_dir():
            raise OrthocalError("is a file; expected a folder", where=str(there))
        probe = there / _temporary_name()
        os.close(os.open(probe, _WRITE_FLAGS, 0o600))
        probe.unlink()
    except (OSError, ValueError) as e:
        raise _refusal(e, folder) from None


def require_writable_file(path: Path, *, kinds: tuple[str, ...] = ()) -> None:
    """Refuse a file to be written later that cannot be one: before the work is done.

    Args:
        path: The file.
        kinds: What its name may end with; anything if empty.

    Raises:
        OrthocalError: If it is a folder, its folder cannot be one, or its name ends otherwise.
        OutputError: If nothing can be written there.
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
    """Refuse what is there under the name of a file to be written, and is no file to write over."""
    target = _behind_links(path)
    try:
        mode = os.stat(target).st_mode
    except (FileNotFoundError, NotADirectoryError):
        return
    if stat.S_ISDIR(mode):
        raise OrthocalError("is a folder; expected a file", where=str(path))
    if not stat.S_ISREG(mode):
        raise OrthocalError("is a device, a pipe or a socket; expected a file", where=str(path))
    if not os.access(target, os.W_OK):
        raise OutputError("is write-protected", where=str(path))


Content = str | bytes | Iterable[bytes]
"""Of a file: text, which is written as UTF-8, bytes, or parts of them."""


def write_file(path: Path, content: Content) -> None:
    """Write a file whole or not at all: beside it first, then renamed.

    Raises:
        OrthocalError: If it cannot be a file.
        OutputError: If it cannot be written.
    """
    require_writable_file(path)
    write_files(path.parent, {path.name: content})


def write_files(folder: Path, files: Mapping[str, Content]) -> None:
    """Write several files of one folder that belong together, all or none.

    All are written beside their places first. Then, with no Ctrl-C between, the old ones but the
    first are taken away, the first is replaced, and the others follow: whenever the process is
    killed, what is there is of one generation. A link is written through; modes stay, and new
    files have the one that the user's mask gives.

    Args:
        folder: Where to; made if need be.
        files: Name to content. Without the first the others mean nothing.

    Raises:
        OrthocalError: If the folder or a file cannot be one.
        OutputError: If they cannot be written.
    """
    require_writable(folder, files)
    try:
        with raised_interrupt():
            _write(folder, files)
    except FileExistsError:
        raise OrthocalError("is a file; expected a folder", where=str(folder)) from None
    except (OSError, ValueError) as e:
        raise _refusal(e, folder) from None


def sync_folder(folder: Path) -> None:
    """Let names of files that were made or replaced survive a power cut, where that can be done."""
    with suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def _write(folder: Path, files: Mapping[str, Content]) -> None:
    """Stage all files, and put them in place; what was staged is taken away whatever happens."""
    staged: dict[Path, Path] = {}
    aside: dict[Path, Path] = {}
    made = [f for f in (folder, *folder.parents) if not f.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, content in files.items():
            target = _behind_links(folder / name)
            _clean_up(target.parent)
            staged[target] = target.with_name(_temporary_name())
            data = content.encode() if isinstance(content, str) else content
            _stage(staged[target], [data] if isinstance(data, bytes) else data, like=target)
        with postponed_interrupt():
            _put_in_place(staged, aside)
    finally:
        for temporary in (*staged.values(), *aside.values()):
            temporary.unlink(missing_ok=True)
        for empty in made:  # nothing was written: as if it had never been tried
            with suppress(OSError):
                empty.rmdir()


def _put_in_place(staged: Mapping[Path, Path], aside: dict[Path, Path]) -> None:
    """Rename files from where they were staged: never two generations side by side.

    Args:
        staged: Place of each file to where it is written already; the first is the one without
            which the others mean nothing.
        aside: Filled with where old files were put that are to go.
    """
    first, *others = staged
    try:
        for target in others:
            old = target.with_name(_temporary_name())
            with suppress(FileNotFoundError):
                os.replace(target, old)
                aside[target] = old
        os.replace(staged[first], first)
    except OSError:
        for target, old in aside.items():
            os.replace(old, target)
        aside.clear()
        raise
    for target in others:
        os.replace(staged[target], target)


def _behind_links(path: Path) -> Path:
    """What a link leads to, whether it is there or not; the path itself if it is none."""
    return Path(os.path.realpath(path)) if path.is_symlink() else path


def _stage(temporary: Path, parts: Iterable[bytes], *, like: Path) -> None:
    """Write a file to be renamed later, with the mode of the one whose place it will take."""
    with open(os.open(temporary, _WRITE_FLAGS, 0o666), "wb") as stream:
        with suppress(FileNotFoundError):
            os.chmod(temporary, stat.S_IMODE(os.stat(like).st_mode))
        stream.writelines(parts)
        stream.flush()
        os.fsync(stream.fileno())


def _temporary_name() -> str:
    return f".orthocal-{os.getpid()}-{secrets.token_hex(8)}.tmp"


def _clean_up(folder: Path) -> None:
    """Take away what processes that were killed have left in a folder."""
    for entry in os.scandir(folder):
        found = _LEFTOVER.fullmatch(entry.name)
        if found and not _is_alive(int(found[1])):
            Path(entry.path).unlink(missing_ok=True)


def _is_alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except OSError:  # it belongs to somebody else
        return True
    return True


def _refusal(e: OSError | ValueError, where: Path) -> OrthocalError:
    """The error of a path that cannot be written: of its name, or of what it stands for."""
    if not isinstance(e, OSError):
        return OrthocalError("holds a character that no name of a file can", where=str(where))
    kind = OrthocalError if e.errno in _NO_NAME else OutputError
    return kind(f"cannot be written: {e.strerror}", where=str(where))
