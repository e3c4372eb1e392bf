"""The command `view`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from typer import Option

import orthocal
from orthocal.cli.options import command
from orthocal.cli.printing import put_note, put_out
from orthocal.io.files import require_writable_file


@command()
def view(
    subject: str,
    posture: str | None = None,
    exaggerate: float | None = None,
    show: str | None = None,
    html: Path | None = None,
    png: Path | None = None,
    size: str = "1400x900",
    port: Annotated[int | None, Option(min=1, max=65535)] = None,
    open_: bool = False,
) -> None:
    """Show a machine, a session or a calibration in 3-D.

    Without --html and --png, a server shows it to browsers on this machine until Ctrl-C.

    Args:
        subject (SESSION|CALIBRATION|ROBOT): session.yaml, calibration.json, a directory that
            contains one, or a robot.
        posture (NAME): Show this posture and its readings; default: all readings.
        exaggerate (FACTOR): Factor that enlarges the deviation of the machine; 1: true scale.
        show (readings|tool|all): Layers that a calibration shows at first.
        html (FILE): Write a page that needs neither network nor server.
        png (FILE): Write a picture; needs an installed Chromium.
        size (WIDTHxHEIGHT): Size of the picture, in pixels.
        port (N): Port to listen on; default: a free one.
        open_: Open the page in a browser.
    """
    from orthocal.output.text.subject import load_subject
    from orthocal.viewer.browser import find_chromium, parse_size, take_picture

    width, height = parse_size(size)
    for path, kinds in ((html, (".html", ".htm")), (png, (".png",))):
        if path is not None:
            require_writable_file(path, kinds=kinds)
    if png is not None:
        find_chromium()
    scene = orthocal.draw_scene(
        load_subject(subject), posture=posture, exaggeration=exaggerate, show=show
    )
    if html is not None:
        put_note(f"Wrote {scene.save(html)}")
    if png is not None:
        put_note(f"Wrote {take_picture(scene.to_html(), png, width=width, height=height)}")
    if html is None and png is None:
        with orthocal.LiveScene(scene, port=port) as live:
            put_out(live.url)
            put_note("Open this in a browser on this machine; Ctrl-C ends.")
            if open_:
                import webbrowser

                webbrowser.open(live.url)
            live.wait()
