"""Screenshots of pages with Chromium."""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
from pathlib import Path

from orthocal.errors import OrthocalError, OutputError
from orthocal.io.files import write_file
from orthocal.runtime.interrupts import raised_interrupt

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
"""Names of the executable, in the order of the search."""

FLAGS = (
    "--headless",
    "--use-gl=angle",  # WebGL without a graphics card
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1",  # no network
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-quic",
    "--disable-sync",
    "--no-first-run",
    "--hide-scrollbars",
)

PAGE_TIME_MS = 4000
"""Virtual time of the page before the screenshot, [ms]."""

BROWSER_TIMEOUT = 120.0
"""Time after which a browser that does not answer is stopped, [s]."""

_SIGNATURE = b"\x89PNG\r\n\x1a\n"


def find_chromium() -> str:
    """Path of Chromium: $ORTHOCAL_CHROMIUM, or the first one on the PATH.

    Raises:
        OrthocalError: If Chromium is not installed.
    """
    named = os.environ.get("ORTHOCAL_CHROMIUM")
    path = next((p for n in ([named] if named else NAMES) if (p := shutil.which(n))), None)
    if path is None:
        tried = f"'{named}' ($ORTHOCAL_CHROMIUM)" if named else ", ".join(NAMES)
        raise OrthocalError(
            f"a picture needs Chromium, which was not found ({tried}). Install it (Debian: "
            "`apt-get install chromium`), or write the page with --html and open it in a browser",
            where="--png",
        )
    return path


def chromium_flags() -> tuple[str, ...]:
    """Flags of Chromium for WebGL without a screen and without a network."""
    root = hasattr(os, "geteuid") and os.geteuid() == 0
    return (*FLAGS, "--no-sandbox") if root else FLAGS  # the sandbox does not work for root


def take_picture(page: str, path: str | Path, *, width: int = 1400, height: int = 900) -> Path:
    """Write a screenshot of a self-contained page.

    Args:
        page: HTML text of the page.
        path: Path of the PNG file.
        width: Width, [px].
        height: Height, [px].

    Raises:
        OrthocalError: If Chromium is missing or takes no picture.
        OutputError: If the picture or its page cannot be written.
    """
    with raised_interrupt():
        try:
            data = _photograph(find_chromium(), page, Path(path), width, height)
        except OSError as e:
            raise OutputError(f"cannot write the page for Chromium: {e}", where="--png") from None
    write_file(Path(path), data)
    return Path(path)


def _photograph(chromium: str, page: str, path: Path, width: int, height: int) -> bytes:
    """Screenshot of a page as PNG; messages name `path`."""
    with tempfile.TemporaryDirectory(prefix="orthocal-", ignore_cleanup_errors=True) as folder:
        source, picture = Path(folder) / "page.html", Path(folder) / "page.png"
        source.write_text(page, encoding="utf-8")
        command = [
            chromium,
            *chromium_flags(),
            f"--user-data-dir={folder}/profile",
            f"--window-size={width},{height}",
            f"--virtual-time-budget={PAGE_TIME_MS}",
            f"--screenshot={picture}",
            f"{source.as_uri()}#picture",
        ]
        try:
            completed = subprocess.run(
                command, capture_output=True, timeout=BROWSER_TIMEOUT, check=False
            )
        except subprocess.TimeoutExpired:
            raise OrthocalError(
                f"{chromium} took no picture in {BROWSER_TIMEOUT:g} s", where=str(path)
            ) from None
        except OSError as e:
            raise OrthocalError(f"cannot run {chromium}: {e.strerror}", where="--png") from None
        data = picture.read_bytes() if picture.is_file() else b""
        if not data.startswith(_SIGNATURE):
            lines = completed.stderr.decode(errors="replace").strip().splitlines()
            reason = f": {lines[-1]}" if lines else ""
            raise OrthocalError(f"{chromium} took no picture{reason}", where=str(path))
    return data


def parse_size(text: str) -> tuple[int, int]:
    """Width and height from a text WIDTHxHEIGHT, [px].

    Raises:
        OrthocalError: If the text is not two integers from 100 to 8000.
    """
    parts = text.lower().split("x")
    if len(parts) == 2 and all(p.isascii() and p.isdigit() for p in parts):
        width, height = int(parts[0]), int(parts[1])
        if 100 <= width <= 8000 and 100 <= height <= 8000:
            return width, height
    raise OrthocalError(
        f"found '{text}'; expected WIDTHxHEIGHT in pixels, such as 1400x900, each 100 to 8000",
        where="--size",
    )
