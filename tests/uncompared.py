"""Plans alone: tests/planning verifies what they are compared with."""

from __future__ import annotations

from contextlib import ExitStack, contextmanager
from unittest.mock import patch

from orthocal.planning import cost_curve, expected_error, tool_candidates
from orthocal.planning.plan_comparison import Comparison


@contextmanager
def uncompared():
    """No usual plans, no other gauges, and a curve of one setup."""
    with ExitStack() as patches:
        for name in ("list_alternatives", "list_usual_plans"):
            patches.enter_context(patch.object(Comparison, name, lambda _: ()))
        patches.enter_context(patch.object(cost_curve, "MAX_SETUPS", 1))
        yield


@contextmanager
def few_machines():
    """Expected errors of plans as means over two drawn machines."""
    with patch.object(expected_error, "N_MACHINES", 2):
        yield


@contextmanager
def few_balls(count):
    """Some of the positions of a fixed ball."""
    with patch.object(tool_candidates, "BALLS", tool_candidates.BALLS[:count]):
        yield
