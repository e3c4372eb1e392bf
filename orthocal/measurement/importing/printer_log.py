"""Import of a printer's log: a robot with the firmware's dimensions, and a session of its bed.

Distances measured on a print form a second setup.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from orthocal.arrays import Array
from orthocal.builder.linear_delta import LinearDelta
from orthocal.effects.loading import load_robot_content
from orthocal.errors import SessionError, errors_at
from orthocal.io.documents import read_text
from orthocal.io.fields import read_only
from orthocal.io.files import exists
from orthocal.measurement.files.session_keys import LARGEST_READING_MM
from orthocal.measurement.files.write_session import write_session
from orthocal.printers.firmwares import FIRMWARES, find_firmware, require_firmware
from orthocal.printers.log import LogText, PrinterLog
from orthocal.printers.settings import FirmwareName
from orthocal.robot.model import Robot
from orthocal.sensors.distance import Distance
from orthocal.sensors.probe import Probe
from orthocal.sensors.tool_indicator import Artefact
from orthocal.session.session import Gauge, Posture, Reading, Session, Setup
from orthocal.units import MM

ROBOT = "printer"

PROBE_STD = 0.02 * MM
"""Standard deviation of a probed height, [m], including the waviness of a bed between the
points."""

TILT_STD = 5e-3
"""Prior standard deviation of the bed's tilt relative to the towers, [rad]."""

CALLIPER_STD = 0.05 * MM
"""Standard deviation of a distance minus the width of its pillar, [m]: seams and blobs."""

WIDTH_STD = 0.025 * MM
"""Prior standard deviation of the common error of all widths of pillars, [m]."""

CALLIPER_RESOLUTION = 0.01 * MM
"""Resolution of a calliper, [m]."""

PRINT_SCALE_STD = 0.001
"""Prior standard deviation of the scale of calliper and print, [1]: plastic shrinks by 0.2 %."""

PRINT_SETUP = "print"
"""Name of the setup of distances."""

RECEIVED = re.compile(r"^(?:[-\d :,]+ - )?Recv: ", re.MULTILINE)
"""Beginning of a line that a host such as OctoPrint received."""

TRAVEL_MARGIN = 10 * MM
"""Travel beyond the endstops and the lowest posture, [m]."""

RANGE_MARGIN = 5 * MM
"""Range of the probe beyond the largest height, [m]."""


@dataclass(frozen=True, slots=True, eq=False)
class PrinterImport:
    """A printer's log as a session with its robot; nothing is written."""

    log: PrinterLog
    session: Session

    @property
    def firmware(self) -> FirmwareName:
        """Firmware of the settings."""
        return self.log.settings.firmware

    @property
    def title(self) -> str:
        """Name of the firmware."""
        return FIRMWARES[self.firmware].title


def recognise_log(path: Path) -> FirmwareName | None:
    """Firmware that wrote a log; None if the file is not clearly such a log."""
    try:
        return find_firmware(_read(path))
    except SessionError:
        return None


def _read(path: Path) -> str:
    """Text of a log as the printer sent it."""
    return RECEIVED.sub("", read_text(path, error=SessionError))


def import_printer_log(
    log: str | Path,
    *,
    firmware: str | None = None,
    settings: Sequence[str | Path] = (),
    radius: float | None = None,
) -> PrinterImport:
    """Read the log of a probed bed: heights at the triggers, and the settings of the firmware.

    Args:
        log: The log: console output, klippy.log, or a printer.cfg with saved heights.
        firmware: klipper, marlin or reprapfirmware; recognised by default.
        settings: Files with settings that the log lacks: printer.cfg, config.g, bed.g, M503.
        radius: Largest distance from the middle that Marlin's G33 or G29 probed, [m].

    Raises:
        SessionError: If a file is wrong or incomplete; names file and line or key.
    """
    source = LogText(tuple((str(p), _read(Path(p))) for p in (*settings, log)), radius)
    name = None if firmware is None else require_firmware(firmware, option="--format")
    name = name or find_firmware(source.text[source.begin :]) or find_firmware(source.text)
    if name is None:
        raise SessionError(
            "is a log of no known firmware, or of several; expected --format "
            f"{', '.join(FIRMWARES)}",
            where=str(log),
        )
    with errors_at(source.name):
        content = FIRMWARES[name].read_log(source)
    return PrinterImport(content, _session(content, Path(log)))


def write_printer_import(result: PrinterImport, folder: str | Path) -> Path:
    """Write the session and, in a subdirectory, its robot.

    Returns:
        Path of the session.yaml.

    Raises:
        SessionError: If the directory contains a session or a robot already.
    """
    folder = Path(folder)
    for name in ("session.yaml", "readings.csv", ROBOT):
        if exists(folder / name):
            raise SessionError("exists already; choose another directory", where=str(folder / name))
    if any(folder.glob("*.urdf")):
        raise SessionError("is the directory of a robot; choose another one", where=str(folder))
    return write_session(result.session, folder)


def _session(log: PrinterLog, path: Path) -> Session:
    """Session of a probed bed.

    When the probe triggers, the nozzle is at the commanded height above the bed. The owner of a
    printer sets the trigger height of the probe separately. So this height has no tolerance, and
    the heights of the bed are absolute.
    """
    robot = _robot(log)
    postures = {f"p{i + 1}": _posture(f"p{i + 1}", c) for i, c in enumerate(log.carriages)}
    x, y, z = log.settings.probe
    surface = Artefact("plate", direction_std=TILT_STD, form_degree=4)
    setup = Setup("bed", Probe("-z", surface, (x, y, z), trigger_std=0.0), "", zero="known")
    readings = tuple(
        Reading("bed", name, value=float(height))
        for name, height in zip(postures, log.heights, strict=True)
    )
    largest = float(np.abs(log.heights).max())
    if largest > LARGEST_READING_MM * MM:
        raise SessionError(
            f"found a height of {largest / MM:g} mm; expected at most {LARGEST_READING_MM:g} mm",
            where=str(path),
        )
    half_range = largest + RANGE_MARGIN
    probe = Gauge(PROBE_STD, None, (-half_range, half_range))
    setups, gauges = {"bed": setup}, {"": probe}
    if log.distances:
        sensor = Distance(width_std=WIDTH_STD, scale_std=PRINT_SCALE_STD)
        setups = {
            "bed": replace(setup, gauge="probe"),
            PRINT_SETUP: Setup(PRINT_SETUP, sensor, "calliper", zero="known"),
        }
        gauges = {"probe": probe, "calliper": Gauge(CALLIPER_STD, CALLIPER_RESOLUTION)}
        for distance in log.distances:
            names = f"{distance.name}_far", f"{distance.name}_near"
            postures |= {n: _posture(n, c) for n, c in zip(names, distance.carriages, strict=True)}
            readings += (Reading(PRINT_SETUP, *names, 1, distance.length),)
    title = FIRMWARES[log.settings.firmware].title
    return Session(
        robot=robot,
        robot_reference=f"./{ROBOT}",
        title=f"Probed bed of a delta printer ({title})",
        source=f"Imported from {path.name}",
        gauges=gauges,
        postures=postures,
        setups=setups,
        readings=readings,
        controller_offsets=read_only(np.zeros(3)),
        firmware=log.settings,
    )


def _posture(name: str, carriages: Array) -> Posture:
    return Posture(name, "joints", read_only(carriages), read_only(carriages))


def _robot(log: PrinterLog) -> Robot:
    """Robot of nominal dimensions: equal rods, towers 120° apart, the firmware's radius.

    Its travel contains all coordinates of the carriages.
    """
    settings = log.settings
    carriages = np.concatenate([log.carriages, *(d.carriages for d in log.distances)])
    machine = LinearDelta(rod=round(float(np.mean(settings.rods)), 6), radius=settings.radius)
    low = max(min(machine.travel[0], carriages.min() - TRAVEL_MARGIN), MM)
    high = max(*settings.homed, carriages.max(), machine.zero) + TRAVEL_MARGIN
    machine = replace(machine, travel=(round(float(low), 3), round(float(high), 3)))
    files = {f"{ROBOT}.urdf": machine.urdf(ROBOT), f"{ROBOT}.yaml": machine.yaml()}
    return load_robot_content(ROBOT, {name: text.encode() for name, text in files.items()})
