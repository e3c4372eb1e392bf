"""Sentences of anomalies."""

from __future__ import annotations

from typing import get_args

import pytest

from orthocal import load_session
from orthocal.assessment.words.anomalies import _text
from orthocal.hypotheses.anomaly import AnomalyKind, Explanation


@pytest.mark.parametrize("kind", get_args(AnomalyKind))
def test_every_kind_has_a_sentence(root, kind):
    """A kind without one would end a command with an internal error."""
    session = load_session(root / "examples/raw-cycles")
    setup, drive = next(iter(session.setups)), session.robot.drives[0].name
    explanation = Explanation(
        kind,
        "setup",
        rows=(0, 1),
        setups=(setup,),
        names=(setup, "50"),
        effect="backlash",
        factor=-1.0,
        amount=1e-3,
        std=1e-4,
        missing=True,
        drives=(drive,),
        active=(1e-3,) * len(session.robot.drives),
        sessions=("first", "second"),
        parameters=(f"{drive}.offset",),
    )
    assert len(_text(session, explanation).split()) > 3
