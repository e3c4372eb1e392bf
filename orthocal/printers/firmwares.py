"""Supported firmwares of delta printers, with their functions for logs and settings."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from orthocal.errors import SessionError
from orthocal.printers import klipper, marlin, reprapfirmware
from orthocal.printers.log import LogText, PrinterLog
from orthocal.printers.settings import DeltaSettings, FirmwareName


@dataclass(frozen=True, slots=True)
class Firmware:
    """Firmware of a delta printer."""

    title: str
    recognise: Callable[[str], bool]
    """Function that recognises a log."""
    read_log: Callable[[LogText], PrinterLog]
    """Function that reads a log."""
    config_lines: Callable[[DeltaSettings], str]
    """Function that writes settings."""
    file: str
    """Name of the file with new settings."""
    tilts: bool = False
    """Whether the tilt of the bed is a setting."""
    equal_rods: bool = False
    """Whether all rods have one length."""


FIRMWARES: dict[FirmwareName, Firmware] = {
    "klipper": Firmware(
        "Klipper", klipper.recognise, klipper.read_log, klipper.config_lines, "printer.cfg"
    ),
    "marlin": Firmware(
        "Marlin", marlin.recognise, marlin.read_log, marlin.config_lines, "marlin.gcode"
    ),
    "marlin1": Firmware(
        "Marlin 1.1",
        lambda _: False,  # its logs are those of Marlin; `marlin.read_log` knows it by its settings
        marlin.read_log_1,
        marlin.config_lines,
        "marlin.gcode",
        equal_rods=True,
    ),
    "reprapfirmware": Firmware(
        "RepRapFirmware",
        reprapfirmware.recognise,
        reprapfirmware.read_log,
        reprapfirmware.config_lines,
        "config.g",
        tilts=True,
    ),
}


def find_firmware(text: str) -> FirmwareName | None:
    """Firmware of a log; None if it is uncertain."""
    recognised = [name for name, firmware in FIRMWARES.items() if firmware.recognise(text)]
    return recognised[0] if len(recognised) == 1 else None


def require_firmware(name: str, *, option: str) -> FirmwareName:
    """Check the name of a firmware.

    Raises:
        SessionError: If the name is unknown.
    """
    for firmware in FIRMWARES:
        if name == firmware:
            return firmware
    raise SessionError(f"found '{name}'; expected {', '.join(FIRMWARES)}", where=option)
