"""The formats that a calibration can be exported to, each a function in a file of its own."""

from __future__ import annotations

from collections.abc import Callable

from orthocal.assessment.assess import assessment_of
from orthocal.calibration.calibration import Calibration
from orthocal.errors import ExportError, ParameterError
from orthocal.export.corrections import export_corrections
from orthocal.export.linuxcnc.export import export_linuxcnc
from orthocal.export.options import ExportOptions
from orthocal.export.parameters import export_parameters
from orthocal.export.urdf import export_urdf

Exporter = Callable[[Calibration, ExportOptions], dict[str, str]]
"""A calibration, and what was asked for, to the texts of files by their names."""


def _without_options(export: Callable[[Calibration], dict[str, str]]) -> Exporter:
    """A format of which nothing can be asked."""

    def exporter(calibration: Calibration, options: ExportOptions) -> dict[str, str]:
        if options.asked:
            name = OPTIONS[options.asked[0]]
            raise ParameterError("goes with --to linuxcnc alone", where=name)
        return export(calibration)

    return exporter


EXPORTERS: dict[str, Exporter] = {
    "yaml": _without_options(export_parameters),
    "table": _without_options(export_corrections),
    "urdf": _without_options(export_urdf),
    "linuxcnc": export_linuxcnc,
}

OPTIONS = {
    "within": "--within",
    "tool": "--tool",
    "home_offsets": "--home-offset",
    "half_side": "--half-side-mm",
    "module": "--module or --offsets",
}


def export_calibration(
    calibration: Calibration,
    to: str,
    *,
    anyway: bool = False,
    options: ExportOptions | None = None,
) -> dict[str, str]:
    """A calibration in some format.

    Args:
        calibration: The calibration.
        to: Name of the format.
        anyway: Also against its verdict, which the files then state.
        options: What is asked for beside the format; nothing by default.

    Returns:
        Texts of files by their names.

    Raises:
        ParameterError: If there is no such format, or it has no such option.
        ExportError: If its verdict is not to enter it, or the machine does not reach what the
            format needs.
    """
    if to not in EXPORTERS:
        raise ParameterError(
            f"found '{to}'; expected one of {', '.join(EXPORTERS)}", where="the format"
        )
    if not anyway:
        require_entering(calibration)
    files = EXPORTERS[to](calibration, options or ExportOptions())
    warning = warn_against_verdict(calibration)
    return _warned(files, warning) if warning else files


def require_entering(calibration: Calibration) -> None:
    """Refuse a calibration whose verdict is to review or to reject the readings.

    Raises:
        ExportError: If its verdict is not to enter it.
    """
    decision = assessment_of(calibration).decision
    if decision.verdict != "enter":
        raise ExportError(f"{decision.headline} {decision.reason} {decision.action}".strip())


def warn_against_verdict(calibration: Calibration) -> str:
    """What is written with a calibration whose verdict is review or reject; empty otherwise."""
    verdict = assessment_of(calibration).decision.verdict
    if verdict == "enter":
        return ""
    return f"Written against the verdict '{verdict}' of the calibration (--anyway)."


def _warned(files: dict[str, str], warning: str) -> dict[str, str]:
    """Files of which one begins with a warning: errors.yaml, or README.md."""
    if "errors.yaml" in files:
        return {**files, "errors.yaml": f"# {warning}\n{files['errors.yaml']}"}
    page = files.get("README.md", "")
    return {**files, "README.md": f"**{warning}**\n" + (f"\n{page}" if page else "")}
