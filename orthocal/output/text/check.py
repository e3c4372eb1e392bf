"""What a check of readings found, as text."""

from __future__ import annotations

from rich.console import Group, RenderableType
from rich.text import Text

from orthocal.assessment.findings.decision import Decision
from orthocal.output.text.layout import bullets, print_rich


def render_check(decision: Decision) -> RenderableType:
    """The decision, all that was found, and what to do first."""
    style = "bold green" if decision.exit_code == 0 else "bold yellow"
    if any(f.severity == "stops" for f in decision.findings):
        style = "bold red"
    parts: list[RenderableType] = [Text.assemble((decision.headline, style), f" {decision.reason}")]
    further = [f.words for f in decision.findings if f.text != decision.reason]
    if further:
        parts += [Text(), bullets(further)]
    if decision.action:
        parts += [Text.assemble(("Next: ", "bold"), decision.action)]
    return Group(*parts)


def print_check(decision: Decision) -> None:
    """Print what was found: in colour where there is a terminal."""
    print_rich(render_check(decision))
