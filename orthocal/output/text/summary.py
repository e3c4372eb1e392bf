"""Calibrations and validations as text that people read: tables, then what they mean."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Group, RenderableType
from rich.text import Text

from orthocal.arguments import require_kind
from orthocal.assessment.assess import assessment_of
from orthocal.calibration.calibration import Calibration
from orthocal.output.text.answer import MORE, render_answer
from orthocal.output.text.layout import bullets, print_rich, section, to_text

if TYPE_CHECKING:
    from orthocal.assessment.comparison import Comparison
    from orthocal.assessment.validation import Validation
    from orthocal.planning.plan import MeasuringPlan
    from orthocal.study.runner import StudyTable

    Result = Calibration | Validation | Comparison | MeasuringPlan | StudyTable


def summarize(
    result: Result, *, details: bool = False, all_rows: bool = False, html: bool = False
) -> str:
    """A calibration, validation, comparison, plan or study as plain text.

    Args:
        result: What to summarise.
        details: Of a calibration all that is known; else the short answer.
        all_rows: List every reading and parameter, however many there are: details, too.
        html: As HTML, as a notebook shows it.
    """
    content = _render(result, details, all_rows)
    if not html:
        return to_text(content)
    from orthocal.output.text.layout import to_markup

    return to_markup(content)


def print_summary(
    result: Result, *, details: bool = False, all_rows: bool = False, saved: Path | None = None
) -> None:
    """Print a calibration, validation, comparison or plan: in colour where there is a terminal.

    Args:
        result: What to print.
        details: Of a calibration everything; otherwise the short answer.
        all_rows: List every reading and parameter.
        saved: Directory in which a calibration was written.
    """
    print_rich(_render(result, details, all_rows, saved))


def _render(
    result: Result, details: bool, all_rows: bool, saved: Path | None = None
) -> RenderableType:
    if isinstance(result, Calibration):
        return render_calibration(result, details=details, all_rows=all_rows, saved=saved)
    from orthocal.assessment.comparison import Comparison
    from orthocal.assessment.validation import Validation
    from orthocal.planning.plan import MeasuringPlan
    from orthocal.study.runner import StudyTable

    kinds = (Calibration, Comparison, Validation, MeasuringPlan, StudyTable)
    expected = "a Calibration, a Comparison, a Validation, a MeasuringPlan or a StudyTable"
    require_kind(result, kinds, expected=expected)
    if isinstance(result, StudyTable):
        from orthocal.output.study.contents import report_study
        from orthocal.output.study.report import render_report

        return render_report(report_study(result, all_rows=all_rows or details))
    if isinstance(result, MeasuringPlan):
        from orthocal.output.text.plan import render_plan

        return render_plan(result, details=details)
    if isinstance(result, Comparison):
        from orthocal.output.text.comparison import render_comparison

        return render_comparison(result, all_rows=all_rows)
    from orthocal.output.text.validation import render_validation

    return render_validation(result, all_rows=all_rows)


def render_calibration(
    calibration: Calibration,
    *,
    details: bool = False,
    all_rows: bool = False,
    saved: Path | None = None,
) -> RenderableType:
    """A calibration as rich renderables: the short answer, and on demand everything else."""
    answer = render_answer(calibration, saved=saved)
    if not (details or all_rows):
        return Group(answer, Text(MORE))
    from orthocal.output.text.accuracy import render_tool
    from orthocal.output.text.entries import render_controller
    from orthocal.output.text.heading import render_origin
    from orthocal.output.text.sensors import render_parts
    from orthocal.output.text.tables import (
        render_fit,
        render_identifiability,
        render_parameters,
        render_residuals,
    )

    return Group(
        answer,
        section("How it was done", render_origin(calibration)),
        section("What was identified", render_parameters(calibration, all_rows=all_rows)),
        section("Identifiability", render_identifiability(calibration, all_rows=all_rows)),
        section("Readings before and after", render_residuals(calibration, all_rows=all_rows)),
        section("How well it fits", render_fit(calibration)),
        *(section("Gauges and sensors", part) for part in render_parts(calibration)),
        section("At the tool", render_tool(calibration)),
        section("Findings", bullets([f.words for f in assessment_of(calibration).findings])),
        section("What to enter into the controller", render_controller(calibration)),
    )
