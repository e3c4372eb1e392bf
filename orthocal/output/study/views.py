"""Any study as text, plain data and a picture, by its kind."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from rich.console import RenderableType

from orthocal.output.study.accuracy import (
    accuracy_document,
    answer_accuracy,
    draw_accuracy,
    render_accuracy,
)
from orthocal.output.study.bootstrap import (
    answer_bootstrap,
    bootstrap_document,
    draw_bootstrap,
    render_bootstrap,
)
from orthocal.output.study.linearisation import (
    answer_linearisation,
    draw_linearisation,
    linearisation_document,
    render_linearisation,
)
from orthocal.output.study.sensitivity import (
    answer_sensitivity,
    draw_sensitivity,
    render_sensitivity,
    sensitivity_document,
)
from orthocal.study.accuracy_summary import AccuracySummary, summarise_accuracy
from orthocal.study.bootstrap import BootstrapSummary, summarise_bootstrap
from orthocal.study.linearisation_summary import LinearisationSummary, summarise_linearisation
from orthocal.study.runner import StudyTable
from orthocal.study.sensitivity import SensitivitySummary, summarise_sensitivity

Summary = AccuracySummary | LinearisationSummary | SensitivitySummary | BootstrapSummary


@dataclass(frozen=True, slots=True)
class View:
    """How a kind of study is shown."""

    summarise: Callable[..., Summary]
    answer: Callable[..., str]
    render: Callable[..., RenderableType]
    document: Callable[..., dict[str, Any]]
    draw: Callable[..., str]


VIEWS = {
    "accuracy": View(
        summarise_accuracy, answer_accuracy, render_accuracy, accuracy_document, draw_accuracy
    ),
    "linearisation": View(
        summarise_linearisation,
        answer_linearisation,
        render_linearisation,
        linearisation_document,
        draw_linearisation,
    ),
    "sensitivity": View(
        summarise_sensitivity,
        answer_sensitivity,
        render_sensitivity,
        sensitivity_document,
        draw_sensitivity,
    ),
    "bootstrap": View(
        summarise_bootstrap,
        answer_bootstrap,
        render_bootstrap,
        bootstrap_document,
        draw_bootstrap,
    ),
}
"""By the kind of a study."""


def summarise_study(table: StudyTable) -> Summary:
    """What a study says, as data."""
    return VIEWS[table.study.kind].summarise(table.study, table)


def render_study(table: StudyTable, summary: Summary, *, all_rows: bool = False) -> RenderableType:
    """A study as rich renderables."""
    return VIEWS[table.study.kind].render(table, summary, all_rows=all_rows)


def study_json(table: StudyTable, summary: Summary) -> str:
    """A study and what it says as JSON: lengths in mm and µm by their names."""
    view = VIEWS[table.study.kind]
    document = {
        "study": table.study.document,
        "digest": table.study.digest,
        "rows": len(table),
        "answer": view.answer(table, summary),
        "summary": view.document(summary),
    }
    return json.dumps(_finite(document), indent=1, allow_nan=False) + "\n"


def draw_study(table: StudyTable, summary: Summary) -> str:
    """A study as an SVG picture."""
    return (
        f'<?xml version="1.0" encoding="utf-8"?>\n{VIEWS[table.study.kind].draw(table, summary)}\n'
    )


def _finite(value: Any) -> Any:  # noqa: ANN401 - plain data
    if isinstance(value, dict):
        return {k: _finite(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(v) for v in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
