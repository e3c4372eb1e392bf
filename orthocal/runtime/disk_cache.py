"""What takes long to find out and is always the same, kept in a folder of the user's own.

The folder is ORTHOCAL_CACHE, or `orthocal` in XDG_CACHE_HOME or ~/.cache; ORTHOCAL_CACHE=off keeps
nothing. It is used only where it is a real folder that belongs to the user and that nobody else can
write to; a file likewise, and only where it holds what its checksum says, for the very key that is
asked for. Whatever else is found is not trusted, and made anew. Nothing that goes wrong here ever
stops a job.
"""

from __future__ import annotations

import hashlib
import os
import secrets
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

VARIABLE = "ORTHOCAL_CACHE"

OFF = frozenset({"", "0", "off", "no", "none"})
"""Values of the variable by which nothing is kept."""

LARGEST_TOTAL = 64 * 2**20
"""Size of all files together, [bytes]; the oldest go first."""

LARGEST_ENTRY = 8 * 2**20
"""Size of one file, [bytes]."""

MOST_ENTRIES = 400

_SUFFIX = ".kept"
_MAGIC = b"orthocal cache 1\n"
_DIGEST = hashlib.sha256().digest_size
_FOLLOW_NOTHING = getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_CLOEXEC", 0)


def recall(key: str) -> bytes | None:
    """What was kept for a key; None where there is nothing that can be trusted.

    Args:
        key: Everything that what is kept depends on.
    """
    try:
        with _folder(create=False) as folder:
            return None if folder is None else _read(folder, key)
    except (OSError, ValueError):
        return None


def keep(key: str, content: bytes) -> None:
    """Keep something for a key, whole or not at all.

    Args:
        key: Everything that it depends on.
        content: At most LARGEST_ENTRY.
    """
    if len(content) > LARGEST_ENTRY:
        return
    with suppress(OSError, ValueError), _folder(create=True) as folder:
        if folder is not None:
            _write(folder, key, content)
            _make_room(folder)


def cache_folder() -> Path | None:
    """Where things are kept; None where nothing is."""
    chosen = os.environ.get(VARIABLE)
    if chosen is not None:
        return None if chosen.strip().lower() in OFF else Path(chosen)
    base = Path(os.environ.get("XDG_CACHE_HOME", ""))
    if not base.is_absolute():
        base = Path(os.path.expanduser("~")) / ".cache"
    return base / "orthocal" if base.is_absolute() else None


@contextmanager
def _folder(*, create: bool) -> Iterator[int | None]:
    """A descriptor of the folder; None where it is not to be used."""
    path = cache_folder()
    if path is None or not hasattr(os, "geteuid") or os.open not in os.supports_dir_fd:
        yield None
        return
    if create:
        path.parent.mkdir(parents=True, exist_ok=True)
        with suppress(FileExistsError):
            path.mkdir(mode=0o700)
    try:
        folder = os.open(path, os.O_RDONLY | os.O_DIRECTORY | _FOLLOW_NOTHING)
    except OSError:
        yield None
        return
    try:
        yield folder if _is_own(os.fstat(folder)) else None
    finally:
        os.close(folder)


def _is_own(status: os.stat_result) -> bool:
    """Whether it belongs to the user, and nobody else can write to it."""
    return status.st_uid == os.geteuid() and not status.st_mode & (stat.S_IWGRP | stat.S_IWOTH)


def _name(key: str) -> str:
    return hashlib.sha256(key.encode()).hexdigest()[:40] + _SUFFIX


def _digest(key: str, content: bytes) -> bytes:
    return hashlib.sha256(b"%d\n%s%s" % (len(key.encode()), key.encode(), content)).digest()


def _read(folder: int, key: str) -> bytes | None:
    descriptor = os.open(
        _name(key), os.O_RDONLY | _FOLLOW_NOTHING | getattr(os, "O_NONBLOCK", 0), dir_fd=folder
    )
    with open(descriptor, "rb") as stream:
        status = os.fstat(descriptor)
        if not (stat.S_ISREG(status.st_mode) and _is_own(status)):
            return None
        found = stream.read(len(_MAGIC) + _DIGEST + LARGEST_ENTRY + 1)
    head, content = found[: len(_MAGIC) + _DIGEST], found[len(_MAGIC) + _DIGEST :]
    return content if head == _MAGIC + _digest(key, content) else None


def _write(folder: int, key: str, content: bytes) -> None:
    beside = f"{secrets.token_hex(8)}.part"
    flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | _FOLLOW_NOTHING
    descriptor = os.open(beside, flags, 0o600, dir_fd=folder)
    try:
        with open(descriptor, "wb") as stream:
            stream.write(_MAGIC + _digest(key, content) + content)
        os.rename(beside, _name(key), src_dir_fd=folder, dst_dir_fd=folder)
    except BaseException:
        with suppress(OSError):
            os.unlink(beside, dir_fd=folder)
        raise


def _make_room(folder: int) -> None:
    """Drop the oldest until the rest is within bounds."""
    found = []
    for name in os.listdir(folder):
        if name.endswith((_SUFFIX, ".part")):
            with suppress(OSError):
                status = os.stat(name, dir_fd=folder, follow_symlinks=False)
                found.append((status.st_mtime, status.st_size, name))
    total, count = sum(size for _, size, _ in found), len(found)
    for _, size, name in sorted(found):
        if total <= LARGEST_TOTAL and count <= MOST_ENTRIES:
            break
        with suppress(OSError):
            os.unlink(name, dir_fd=folder)
        total, count = total - size, count - 1
