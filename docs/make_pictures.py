"""Make the README's pictures with the program itself; needs Chromium."""

from __future__ import annotations

from pathlib import Path

from orthocal import calibrate, draw_scene, load_session
from orthocal.output.report.page import build_report
from orthocal.viewer.browser import take_picture

ROOT = Path(__file__).parents[1]


def main() -> None:
    """Write docs/scene.png and docs/report.png."""
    calibration = calibrate(load_session(ROOT / "examples/table1/experiment-2"))
    scene = draw_scene(calibration).to_html()
    take_picture(scene, ROOT / "docs/scene.png", width=1080, height=720)
    report = build_report(calibration, saved=Path("/home/user/out/experiment-2"))
    take_picture(report, ROOT / "docs/report.png", width=960, height=1240)


if __name__ == "__main__":
    main()
