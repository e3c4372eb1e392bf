"""The firmwares: recognition and reading of logs, lines with settings."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from orthocal.errors import SessionError
from orthocal.printers import klipper, marlin, reprapfirmware
from orthocal.printers.log import PrinterLog
from orthocal.printers.settings import DeltaSettings, FirmwareName


@dataclass(frozen=True, slots=True)
class Firmware:
    """A firmware."""

    title: str
    recognise: Callable[[str], bool]
    read_log: Callable[..., PrinterLog]
    config_lines: Callable[[DeltaSettings], str]
    file: str
    """Name of the file with new settings."""
    tilts: bool = False
    """Whether it knows the tilt of the bed."""


FIRMWARES: dict[FirmwareName, Firmware] = {
    "klipper": Firmware(
        "Klipper", klipper.recognise, klipper.read_log, klipper.config_lines, "printer.cfg"
    ),
    "marlin": Firmware(
        "Marlin", marlin.recognise, marlin.read_log, marlin.config_lines, "marlin.gcode"
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
    """Firmware of a log, where it is certain."""
    recognised = [name for name, firmware in FIRMWARES.items() if firmware.recognise(text)]
    return recognised[0] if len(recognised) == 1 else None


def require_firmware(name: str, *, option: str) -> FirmwareName:
    """A firmware by its name.

    Raises:
        SessionError: If there is none of this name.
    """
    for known in FIRMWARES:
        if name == known:
            return known
    raise SessionError(f"found '{name}'; expected {', '.join(FIRMWARES)}", where=option)
