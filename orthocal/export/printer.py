"""Export of a calibration to the firmware of a delta printer: its lines, and a page."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

from orthocal.assessment.printer_settings import FirmwareFit, fit_firmware
from orthocal.assessment.wording import tool_mm
from orthocal.calibration.calibration import Calibration
from orthocal.printers.firmwares import FIRMWARES
from orthocal.printers.settings import FirmwareName
from orthocal.text import quote_path


def export_printer(calibration: Calibration, firmware: FirmwareName) -> dict[str, str]:
    """File with the new settings of a firmware, and README.md.

    Raises:
        ExportError: If the session states no settings, or the machine does not reach its bed.
    """
    fit = fit_firmware(calibration, firmware)
    target = FIRMWARES[firmware]
    return {target.file: target.config_lines(fit.settings), "README.md": _page(calibration, fit)}


_SEND = (
    "Send the lines of `marlin.gcode`. `M500` saves them. Without EEPROM, change the values of the "
    "same names in `Configuration.h`."
)
_HOME = "Home (`G28`). An existing mesh of `G29` is no longer valid: `M420 S0`."

STEPS: dict[FirmwareName, Sequence[str]] = {
    "klipper": (
        "Replace these lines in your `printer.cfg`. Values of a part `SAVE_CONFIG` at its end take "
        "precedence: replace them there.",
        "`RESTART`, then home.",
    ),
    "marlin": (
        f"{_SEND} If `M503` prints no A, B and C in `M665`, your Marlin has one length for all "
        "rods: export with `--to marlin1`.",
        _HOME,
    ),
    "marlin1": (_SEND, _HOME),
    "reprapfirmware": (
        "Replace `M665` and `M666` in `config.g`. Delete these commands in `config-override.g`.",
        "Restart, then home (`G28`). An existing height map is no longer valid: `G29 S2`.",
    ),
}
"""How to enter the settings."""


SIZE = (
    "A probed bed hardly determines the size of a print: longer rods with a larger radius print "
    "equally flat. Measure a large print, or the rods."
)

UNCERTAIN = (
    "± is the uncertainty of a single setting (95 %). Settings compensate each other: longer rods "
    "with a larger radius print equally flat."
)


def _format(number: float) -> str:
    """Number with three decimals; empty if it is unknown."""
    return f"{number:.3f}" if math.isfinite(number) else ""


def describe_settings(fit: FirmwareFit) -> str:
    """Table of the present and the new settings as text."""
    lines = [f"  {'':20}{'now':>10}{'new':>10}{'±':>9}"]
    lines += [
        f"  {r.name:20}{r.now:10.3f}{r.new:10.3f}{_format(r.uncertainty):>9}  {r.unit}"
        for r in fit.rows
    ]
    return "\n".join(lines)


def describe_next(fit: FirmwareFit, calibration: Path, out: Path) -> str:
    """Next step after an export: to enter the settings and probe again, or nothing.

    Args:
        fit: The settings.
        calibration: Directory of the calibration.
        out: Directory of the export.
    """
    if not fit.worth_entering:
        return "Next: print. Nothing more has to be entered: these settings are hardly better."
    file = out / FIRMWARES[fit.settings.firmware].file
    saved, again = (quote_path(p) for p in (calibration, f"{out}-bed"))
    return (
        f"Next: enter the lines of {file}, home, probe again and judge the new log:\n"
        f"  orthocal import NEW_LOG {again}\n"
        f"  orthocal validate {saved} {again}"
    )


def _page(calibration: Calibration, fit: FirmwareFit) -> str:
    """README.md: steps, settings and expected errors."""
    settings = fit.settings
    firmware = FIRMWARES[settings.firmware]
    steps = (
        *STEPS[settings.firmware],
        "Probe the bed again. Import the new log into another directory and let "
        "`orthocal validate` judge it. The height of the probe (z offset) does not change: set it "
        "with paper as before.",
    )
    table = [
        f"| {r.name} | {r.now:.3f} | {r.new:.3f} | {_format(r.uncertainty)} | {r.unit} |"
        for r in fit.rows
    ]
    return "\n".join(
        [
            f"# Settings for {firmware.title}",
            "",
            f"`{firmware.file}`:",
            "",
            "```",
            firmware.config_lines(settings).rstrip(),
            "```",
            "",
            *(f"{i}. {step}" for i, step in enumerate(steps, start=1)),
            "",
            "| | now | new | ± | |",
            "|---|---|---|---|---|",
            *table,
            "",
            *([] if calibration.unmodelled.prior_stds.size else [UNCERTAIN, ""]),
            "## What to expect",
            "",
            *_expectations(calibration, firmware.title, fit),
            "",
        ]
    )


def _expectations(calibration: Calibration, title: str, fit: FirmwareFit) -> list[str]:
    """Table of the expected errors, and their limits."""

    def row(words: str, *values: float) -> str:
        return f"| {words} | {' | '.join(tool_mm(v).removesuffix(' mm') for v in values)} |"

    tool, layer = ((e(fit.now), e(fit.new)) for e in (fit.expect_tool, fit.expect_layer))
    new = fit.new
    return [
        "| expected error, RMS in mm | now | new |",
        "|---|---|---|",
        row("tool, over the workspace", *tool),
        row("height of the first layer", *layer),
        "",
        f"{title} has no other settings for the geometry. Errors that they cannot express, such as "
        f"towers that lean, leave {tool_mm(new.tool_rms)} at the tool (largest "
        f"{tool_mm(new.tool_largest)}) and {tool_mm(new.layer_rms)} in the height of the first "
        f"layer (largest {tool_mm(new.layer_largest)}). The rest is the uncertainty of the "
        "calibration.",
        *([] if any(s.sensor.kind == "distance" for s in calibration.setups) else ["", SIZE]),
    ]
