"""Pages in headless Chromium without a network, driven by Playwright.

A missing browser is a failure if $ORTHOCAL_BROWSER is `required`, as in continuous integration;
otherwise the tests are skipped.
"""

from __future__ import annotations

import base64
import io
import os
import time
from contextlib import contextmanager
from dataclasses import dataclass, field

import numpy as np
import pytest
from PIL import Image

from orthocal.errors import OrthocalError
from orthocal.viewer.browser import chromium_flags, find_chromium

PATIENCE = 60.0
"""Longest wait for an expected event, [s]."""

SIZES = ((1400, 900), (800, 600))

NARROW = (420, 640)
"""Size of a page on a telephone, as in a report there."""

SMALL = (480, 360)
"""Size for tests that do not depend on it: pages are drawn by software, which is slow."""

COARSE = "--disable_chromium_framebuffer_multisample"
"""Flag that turns anti-aliasing off, which would draw each pixel four times."""


@dataclass
class Visit:
    """An open page with its messages and requests."""

    page: object
    messages: list[str] = field(default_factory=list)
    requests: list[str] = field(default_factory=list)

    def wait_for(self, expression, *, frame=None):
        """Wait until a JavaScript expression is true; pages forbid Playwright's own function."""
        end = time.monotonic() + PATIENCE
        while not (frame or self.page).evaluate(expression):
            if time.monotonic() > end:
                pytest.fail(f"not in {PATIENCE} s: {expression}")
            time.sleep(0.02)

    def wait_until_drawn(self, *, frame=None):
        """Wait until the page has been drawn after loading.

        The viewer draws only after a change, so that one more drawing is requested.
        """
        self.wait_for("document.readyState === 'complete' && 'viewer' in window", frame=frame)
        drawn = "Number(document.documentElement.dataset.rendered || 0)"
        seen = (frame or self.page).evaluate(f"(viewer.set_dirty(), {drawn})")
        self.wait_for(f"{drawn} > {seen}", frame=frame)

    def resize(self, size):
        """Change the size of the window and wait until the page has been drawn."""
        self.page.set_viewport_size({"width": size[0], "height": size[1]})
        self.wait_until_drawn()

    def picture(self):
        """Screenshot of the page, shape (height, width, 3)."""
        return np.asarray(Image.open(io.BytesIO(self.page.screenshot())).convert("RGB"))

    def canvas(self):
        """Image of the 3-D canvas, shape (height, width, 4)."""
        data = self.page.evaluate("viewer.capture_image()").split(",", 1)[1]
        return np.asarray(Image.open(io.BytesIO(base64.b64decode(data))).convert("RGBA"))


def require_browser():
    """Path of Chromium; skip or fail without it."""
    try:
        import playwright.sync_api  # noqa: F401

        return find_chromium()
    except (ImportError, OrthocalError) as e:
        if os.environ.get("ORTHOCAL_BROWSER") == "required":
            pytest.fail(f"a browser is required here: {e}")
        pytest.skip(f"no browser to look with: {e}")


@contextmanager
def open_browser():
    executable = require_browser()
    from playwright.sync_api import sync_playwright

    with sync_playwright() as play:
        browser = play.chromium.launch(
            executable_path=executable, args=[*chromium_flags(), COARSE], headless=True
        )
        try:
            yield browser
        finally:
            browser.close()


@contextmanager
def visit(browser, url, *, size=SIZES[0], online=False):
    """Open a page without a network, or `online` from a server on this machine."""
    context = browser.new_context(
        viewport={"width": size[0], "height": size[1]}, offline=not online
    )
    try:
        page = context.new_page()
        found = Visit(page)
        page.on("console", lambda m: found.messages.append(f"{m.type}: {m.text}"))
        page.on("pageerror", lambda e: found.messages.append(f"error: {e}"))
        page.on("request", lambda r: found.requests.append(r.url))
        page.goto(url)
        yield found
    finally:
        context.close()
