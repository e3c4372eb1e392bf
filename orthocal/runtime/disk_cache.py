"""Cache of reproducible results of long computations in a directory of the user.

The directory is ORTHOCAL_CACHE, or `orthocal` in XDG_CACHE_HOME or ~/.cache; ORTHOCAL_CACHE=off
disables the cache. Directory and files are used only if the user owns them, nobody else can write
to them, and a file only if its checksum is right. Otherwise the result is computed again. Failures
of the cache are ignored.
"""

from __future__ import annotations

import hashlib
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

VARIABLE = "ORTHOCAL_CACHE"
"""Environment variable with the directory of the cache."""

OFF = frozenset({"", "0", "off", "no", "none"})
"""Values of the variable that disable the cache."""

LARGEST_TOTAL = 64 * 2**20
"""Largest size of all files together, [bytes]; those used longest ago are removed first."""

LARGEST_ENTRY = 8 * 2**20
"""Largest size of one file, [bytes]."""

MOST_ENTRIES = 400
"""Largest number of files, exceeded by those stored since unused ones were last removed."""

CHECKED = "0"
"""Begin of the names of files after whose storage unused ones are removed: one in 16."""

_SUFFIX = ".kept"
_MAGIC = b"orthocal cache 1\n"
_HEADER_SIZE = len(_MAGIC) + hashlib.sha256().digest_size
_NO_LINKS = getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_CLOEXEC", 0)


def load(key: str) -> bytes | None:
    """Content stored for a key; None if there is no trusted content.

    Args:
        key: Text with everything that the content depends on.
    """
    try:
        with _opened_folder(create=False) as folder:
            return None if folder is None else _read(folder, key)
    except (OSError, ValueError):
        return None


def store(key: str, content: bytes) -> None:
    """Store content for a key, atomically.

    Args:
        key: Text with everything that the content depends on.
        content: The content; more than LARGEST_ENTRY bytes are not stored.
    """
    if len(content) > LARGEST_ENTRY:
        return
    with suppress(OSError, ValueError), _opened_folder(create=True) as folder:
        if folder is not None:
            _write(folder, key, content)
            if _name(key).startswith(CHECKED):
                _remove_unused(folder)


def cache_folder() -> Path | None:
    """Directory of the cache; None if it is disabled."""
    chosen = os.environ.get(VARIABLE)
    if chosen is not None:
        return None if chosen.strip().lower() in OFF else Path(chosen)
    base = Path(os.environ.get("XDG_CACHE_HOME", ""))
    if not base.is_absolute():
        base = Path(os.path.expanduser("~")) / ".cache"
    return base / "orthocal" if base.is_absolute() else None


@contextmanager
def _opened_folder(*, create: bool) -> Iterator[int | None]:
    """Descriptor of the directory; None if it cannot be trusted."""
    path = cache_folder()
    if path is None or not hasattr(os, "geteuid") or os.open not in os.supports_dir_fd:
        yield None
        return
    if create:
        path.parent.mkdir(parents=True, exist_ok=True)
        with suppress(FileExistsError):
            path.mkdir(mode=0o700)
    try:
        folder = os.open(path, os.O_RDONLY | os.O_DIRECTORY | _NO_LINKS)
    except OSError:
        yield None
        return
    try:
        yield folder if _is_private(os.fstat(folder)) else None
    finally:
        os.close(folder)


def _is_private(status: os.stat_result) -> bool:
    """True for a file or directory that the user owns and nobody else can write to."""
    return status.st_uid == os.geteuid() and not status.st_mode & (stat.S_IWGRP | stat.S_IWOTH)


def _name(key: str) -> str:
    return hashlib.sha256(key.encode()).hexdigest()[:40] + _SUFFIX


def _digest(key: str, content: bytes) -> bytes:
    return hashlib.sha256(b"%d\n%s%s" % (len(key.encode()), key.encode(), content)).digest()


def _read(folder: int, key: str) -> bytes | None:
    descriptor = os.open(
        _name(key), os.O_RDONLY | _NO_LINKS | getattr(os, "O_NONBLOCK", 0), dir_fd=folder
    )
    with open(descriptor, "rb") as stream:
        status = os.fstat(descriptor)
        is_small = status.st_size <= _HEADER_SIZE + LARGEST_ENTRY
        if not (stat.S_ISREG(status.st_mode) and is_small and _is_private(status)):
            return None
        data = stream.read(status.st_size)
        with suppress(OSError, TypeError):
            os.utime(descriptor)  # it was used now: what was used long ago is removed first
    header, content = data[:_HEADER_SIZE], data[_HEADER_SIZE:]
    return content if header == _MAGIC + _digest(key, content) else None


def _write(folder: int, key: str, content: bytes) -> None:
    temporary = f"{os.urandom(8).hex()}.part"
    flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | _NO_LINKS
    descriptor = os.open(temporary, flags, 0o600, dir_fd=folder)
    try:
        with open(descriptor, "wb") as stream:
            stream.write(_MAGIC + _digest(key, content) + content)
        os.rename(temporary, _name(key), src_dir_fd=folder, dst_dir_fd=folder)
    except BaseException:  # after an interrupt, too, no part remains
        with suppress(OSError):
            os.unlink(temporary, dir_fd=folder)
        raise


def _remove_unused(folder: int) -> None:
    """Remove the files used longest ago until the remaining ones are within the limits."""
    entries = []
    for name in os.listdir(folder):
        if name.endswith((_SUFFIX, ".part")):
            with suppress(OSError):
                status = os.stat(name, dir_fd=folder, follow_symlinks=False)
                entries.append((status.st_mtime, status.st_size, name))
    total, count = sum(size for _, size, _ in entries), len(entries)
    for _, size, name in sorted(entries):
        if total <= LARGEST_TOTAL and count <= MOST_ENTRIES:
            break
        with suppress(OSError):
            os.unlink(name, dir_fd=folder)
        total, count = total - size, count - 1
