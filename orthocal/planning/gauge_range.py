"""A dial as one has it: dial.yaml, the keys of a session's gauge and of how well it stands."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from orthocal.errors import SessionError
from orthocal.io.documents import read_yaml, validate
from orthocal.measurement.files.schema import GaugeKeys
from orthocal.planning.equipment import Means
from orthocal.planning.expected_error import state_noise
from orthocal.sensors.leg_indicator import LegIndicator
from orthocal.sensors.mounting import Standing, StandingKeys
from orthocal.sensors.rod_indicator import RodIndicator
from orthocal.sensors.tips import Tip
from orthocal.session.session import Gauge, Session
from orthocal.units import MM

OF_STANDING = ("direction_tolerance_mrad", "section_tolerance_mm", "lateral_tolerance_mm")


def load_dial(path: str | Path, means: Means) -> Means:
    """What one has, with the dial that a file describes.

    Args:
        path: YAML with `sigma_mm`, `resolution_mm`, `range_mm`, `tip` and `scale_tolerance` as
            under `gauge` in a session.yaml, and `direction_tolerance_mrad`, `section_tolerance_mm`
            and `lateral_tolerance_mm` as in its setups. Without `tip` a line is read.
        means: All else.

    Raises:
        SessionError: Naming file and key.
    """
    file = Path(path)
    found = read_yaml(file, error=SessionError)
    if not isinstance(found, dict):
        raise SessionError("expected keys and values, such as sigma_mm: 0.005", where=str(file))
    data: dict[str, Any] = dict(found)
    own = {k: data.pop(k) for k in OF_STANDING if k in data}
    gauge = validate(GaugeKeys, data, where=str(file), error=SessionError)
    if gauge.scale_tolerance is not None:
        own["scale_tolerance"] = gauge.scale_tolerance
    standing = Standing.from_keys(validate(StandingKeys, own, where=str(file), error=SessionError))
    if gauge.sigma_mm is None and gauge.resolution_mm is None:
        raise SessionError(
            "is missing: without the scatter of its readings no plan can say what they are worth",
            where=f"{file}: sigma_mm",
        )
    return replace(
        means,
        gauge=Gauge(
            None if gauge.sigma_mm is None else gauge.sigma_mm * MM,
            None if gauge.resolution_mm is None else gauge.resolution_mm * MM,
            None if gauge.range_mm is None else (gauge.range_mm[0] * MM, gauge.range_mm[1] * MM),
        ),
        tip=None if gauge.tip is None else Tip.from_keys(gauge.tip),
        standing=standing,
    )


def means_of(session: Session, means: Means) -> Means:
    """What one has, with the dial of a session, and what it touched there.

    Args:
        session: The session; of several gauges and sensors the first counts.
        means: All else.

    Raises:
        SessionError: If nothing tells the noise of its readings.
    """
    session = state_noise(session)
    sensors = [s.sensor for s in session.setups.values()]
    on_rods = [s for s in sensors if isinstance(s, RodIndicator)]
    on_lines = [s for s in sensors if isinstance(s, LegIndicator)]
    if on_rods:
        rods = means.rods or tuple(dict.fromkeys(s.rod for s in on_rods))
        standing = replace(on_rods[0].standing, stand=None)
        return replace(means, gauge=session.gauge, tip=on_rods[0].tip, standing=standing, rods=rods)
    standing = replace(on_lines[0].standing, stand=None) if on_lines else means.standing
    return replace(means, gauge=session.gauge, tip=None, standing=standing)
