"""Results as text and as JSON: calibrations, validations, comparisons, plans and studies."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

from rich.console import Group, RenderableType
from rich.text import Text

from orthocal.arguments import require_kind
from orthocal.assessment.assess import assessment_of
from orthocal.calibration.assessment_record import Assessment
from orthocal.calibration.calibration import Calibration
from orthocal.io.documents import format_json
from orthocal.output.text.answer import (
    MORE,
    name_values,
    render_answer,
    render_method,
    render_values,
)
from orthocal.output.text.layout import section, to_markup, to_text

if TYPE_CHECKING:
    from orthocal.assessment.comparison import Comparison
    from orthocal.assessment.validation import Validation
    from orthocal.planning.plan import MeasuringPlan
    from orthocal.study.runner import StudyTable

    Result: TypeAlias = Calibration | Validation | Comparison | MeasuringPlan | StudyTable


def summarize(
    result: Result, *, details: bool = False, all_rows: bool = False, html: bool = False
) -> str:
    """A calibration, validation, comparison, plan or study as plain text.

    Args:
        result: The result.
        details: Whether to describe a result completely, not by the short answer.
        all_rows: Whether to list every reading and parameter; includes the details.
        html: Whether to return HTML, as a notebook shows it.
    """
    content = render_result(result, details=details, all_rows=all_rows)
    return to_markup(content) if html else to_text(content)


def render_result(
    result: Result, *, details: bool = False, all_rows: bool = False, saved: Path | None = None
) -> RenderableType:
    """A result as rich renderables.

    Args:
        result: The result.
        details: Whether to describe a result completely, not by the short answer.
        all_rows: Whether to list every reading and parameter; includes the details.
        saved: Directory in which a calibration was written.
    """
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
        from orthocal.output.text.study import render_report, report_study

        return render_report(report_study(result, all_rows=all_rows or details))
    if isinstance(result, MeasuringPlan):
        from orthocal.output.text.plan import render_plan

        return render_plan(result, details=details or all_rows)
    if isinstance(result, Comparison):
        from orthocal.output.text.comparison import render_comparison

        return render_comparison(result, details=details, all_rows=all_rows)
    from orthocal.output.text.validation import render_validation

    return render_validation(result, details=details, all_rows=all_rows)


def render_calibration(
    calibration: Calibration,
    *,
    details: bool = False,
    all_rows: bool = False,
    saved: Path | None = None,
) -> RenderableType:
    """A calibration as rich renderables: the short answer, and on demand the details."""
    if not (details or all_rows):
        return Group(render_answer(calibration, saved=saved), Text(MORE))
    from orthocal.output.text import tables
    from orthocal.output.text.accuracy import expect_further_hour, render_tool

    further = expect_further_hour(calibration)
    answer = render_answer(calibration, saved=saved, further=further)
    sections: dict[str, RenderableType | None] = {
        "Method": render_method(calibration),
        "Parameters": tables.render_parameters(calibration, all_rows=all_rows),
        "Readings": tables.render_readings(calibration, all_rows=all_rows),
        "Residuals": tables.render_fit(calibration),
        "Gauges and sensors": tables.render_sensors(calibration),
        "Tool error": render_tool(calibration, further),
        "Findings": tables.render_findings(calibration),
        name_values(calibration): render_values(calibration),
        "For research": tables.render_identifiability(calibration, all_rows=all_rows),
    }
    return Group(answer, *(section(name, part) for name, part in sections.items() if part))


def result_json(result: Calibration | Validation | Comparison | Assessment) -> str:
    """A result as JSON, with `decision` and `findings` at the top level.

    The JSON of a calibration loads like calibration.json.

    Raises:
        TypeError: If the result is of another kind.
    """
    if isinstance(result, Calibration):
        from orthocal.calibration.file import calibration_document

        document = calibration_document(result)
    elif isinstance(result, Assessment):
        document = {}
    else:
        from orthocal.assessment.comparison import Comparison
        from orthocal.assessment.validation import Validation

        expected = "a Calibration, a Validation, a Comparison or an Assessment"
        require_kind(result, (Validation, Comparison), expected=expected)
        document = json.loads(result.to_json())
    document |= assessment_in(result).to_document()
    return format_json(document)


def assessment_in(result: Calibration | Validation | Comparison | Assessment) -> Assessment:
    """The assessment of readings that a result contains."""
    if isinstance(result, Calibration):
        return assessment_of(result)
    return result if isinstance(result, Assessment) else result.assessment
