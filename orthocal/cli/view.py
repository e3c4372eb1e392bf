"""The command `view`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from typer import Argument, Option

from orthocal.cli.options import app
from orthocal.cli.printing import put_note, put_out

if TYPE_CHECKING:
    from orthocal.viewer.scene import Scene


@app.command()
def view(
    subject: Annotated[
        str,
        Argument(
            metavar="SESSION|CALIBRATION|ROBOT",
            help="session.yaml, calibration.json, a directory that contains one, or a robot.",
        ),
    ],
    posture: Annotated[
        str | None,
        Option(metavar="NAME", help="Show this posture and its readings; default: all readings."),
    ] = None,
    exaggerate: Annotated[
        float | None,
        Option(
            metavar="FACTOR",
            help="Factor that enlarges the deviation of the machine; 1: true scale.",
        ),
    ] = None,
    show: Annotated[
        str | None,
        Option(metavar="readings|tool|all", help="Layers that a calibration shows at first."),
    ] = None,
    html: Annotated[
        Path | None,
        Option(metavar="FILE", help="Write a page that needs neither network nor server."),
    ] = None,
    png: Annotated[
        Path | None, Option(metavar="FILE", help="Write a picture; needs an installed Chromium.")
    ] = None,
    size: Annotated[
        str, Option(metavar="WIDTHxHEIGHT", help="Size of the picture, in pixels.")
    ] = "1400x900",
    port: Annotated[
        int | None,
        Option(min=1, max=65535, metavar="N", help="Port to listen on; default: a free one."),
    ] = None,
    browse: Annotated[bool, Option("--open", help="Open the page in a browser.")] = False,
) -> None:
    """Show a machine, a session or a calibration in 3-D.

    Without --html and --png, a server shows it to browsers on this machine until Ctrl-C.
    """
    from orthocal.io.files import require_writable_file
    from orthocal.output.scene.drawing import draw_scene
    from orthocal.output.text.subject import load_subject
    from orthocal.viewer.browser import find_chromium, parse_size, take_picture

    width, height = parse_size(size)
    for path, kinds in ((html, (".html", ".htm")), (png, (".png",))):
        if path is not None:
            require_writable_file(path, kinds=kinds)
    if png is not None:
        find_chromium()
    scene = draw_scene(load_subject(subject), posture=posture, exaggeration=exaggerate, show=show)
    if html is not None:
        put_note(f"Wrote {scene.save(html)}")
    if png is not None:
        put_note(f"Wrote {take_picture(scene.to_html(), png, width=width, height=height)}")
    if html is None and png is None:
        _serve(scene, port, browse)


def _serve(scene: Scene, port: int | None, browse: bool) -> None:
    """Serve a scene until Ctrl-C."""
    from orthocal.viewer.live import LiveScene

    with LiveScene(scene, port=port) as live:
        put_out(live.url)
        put_note("Open this in a browser on this machine; Ctrl-C ends.")
        if browse:
            import webbrowser

            webbrowser.open(live.url)
        live.wait()
