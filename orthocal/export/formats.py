"""The formats that a calibration can be exported to, each a function in a file of its own."""

from __future__ import annotations

from collections.abc import Callable

from orthocal.assess.findings.calibration import decide
from orthocal.calibration.calibration import Calibration
from orthocal.errors import ExportError, ParameterError
from orthocal.export.corrections import export_corrections
from orthocal.export.parameters import export_parameters
from orthocal.export.urdf import export_urdf

Exporter = Callable[[Calibration], dict[str, str]]
"""A calibration to the texts of files, by their names."""

EXPORTERS: dict[str, Exporter] = {
    "yaml": export_parameters,
    "table": export_corrections,
    "urdf": export_urdf,
}


def export_calibration(
    calibration: Calibration, to: str, *, anyway: bool = False
) -> dict[str, str]:
    """A calibration in some format.

    Args:
        calibration: The calibration.
        to: Name of the format.
        anyway: Also where its decision is not to enter it.

    Returns:
        Texts of files by their names.

    Raises:
        ParameterError: If there is no such format.
        ExportError: If its decision is not to enter it, or the machine does not reach what the
            format needs.
    """
    if to not in EXPORTERS:
        raise ParameterError(
            f"found '{to}'; expected one of {', '.join(EXPORTERS)}", where="the format"
        )
    if not anyway:
        require_entering(calibration)
    return EXPORTERS[to](calibration)


def require_entering(calibration: Calibration) -> None:
    """Refuse a calibration that is not to be entered.

    Raises:
        ExportError: If its decision is not to enter it.
    """
    decision = decide(calibration)
    if decision.answer == "do not enter":
        raise ExportError(f"{decision.headline} {decision.reason} {decision.action}".strip())
