"""Sentences of anomalies."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
from calibrated import session_of

from orthocal import join_sessions
from orthocal.assessment.words.anomalies import _text, describe_anomalies
from orthocal.assessment.words.remedies import advise, advise_about_sessions, advise_repetition
from orthocal.hypotheses.anomaly import Anomalies, Anomaly, AnomalyKind, Explanation
from orthocal.printers.settings import DeltaSettings
from orthocal.units import MM


@pytest.fixture(scope="module")
def session():
    return session_of("raw-cycles")


def describe_alternatives(session, explanation, alternative):
    anomaly = Anomaly(explanation, 9.0, None, alternatives=(alternative,))
    found = Anomalies((anomaly,), True, 1e-4, 1e-5, 1.0)
    (finding,) = describe_anomalies(session, found)
    return finding


@pytest.mark.parametrize("kind", get_args(AnomalyKind))
def test_every_kind_has_a_sentence(session, kind):
    """A kind without one would end a command with an internal error."""
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


@pytest.mark.parametrize(
    ("stated", "change", "advised"),
    [
        (3001.400123, {"amount": 1e-3}, "write +3000.400123 instead of +3001.400123."),
        (-3412.345678, {"factor": -1.0}, "write +3412.345678 instead of -3412.345678."),
        (0.44, {"factor": -1.0}, "write -0.44 instead of +0.44."),
    ],
)
def test_a_corrected_reading_has_the_micrometres_of_the_stated_one(
    session, stated, change, advised
):
    """Points are metres away from the zero of their station."""
    first, *others = session.readings
    session = replace(session, readings=(replace(first, value=stated * MM), *others))
    explanation = Explanation("misread dial", "reading", rows=(0,), **change)
    assert advised in advise(session, explanation)


def test_offsets_of_a_session_are_not_compared_with_home_offset(session):
    """LinuxCNC displays no number that equals them; backlash is BACKLASH."""
    drive = session.robot.drives[0].name
    for kind, key, differs in (
        ("offsets not entered", "controller.offsets_mm", True),
        ("backlash halved", "controller.backlash_mm", False),
    ):
        explanation = Explanation(kind, "session", drives=(drive,), sessions=("second",))
        action = advise_about_sessions(session, explanation)
        assert f"`{key}` of session second" in action
        assert ("They are not HOME_OFFSET." in action) == differs
        assert ("joints.ini" in action) == differs


def test_an_action_that_costs_no_reading_comes_first(session):
    """Calibrate with an effect; reverse signs of setups; read one of many again for their unit."""
    sign = Explanation("reversed sign", "reading", rows=(3,), factor=-1.0)
    setup, other = (
        Explanation("reversed sign", "setup", rows=(row,), setups=(name,), factor=-1.0)
        for row, name in zip((0, 9), session.setups, strict=False)
    )
    rows = tuple(range(len(session.readings)))
    inches, point = (
        Explanation(kind, "all", rows=rows, factor=factor)
        for kind, factor in (("wrong unit", 25.4), ("decimal point", 10.0))
    )
    backlash = Explanation(
        "backlash",
        "reading",
        rows=(0, 1),
        effect="backlash",
        parameters=("x_slide.backlash",),
        amounts=(2e-5,),
        stds=(4e-6,),
        units=("m",),
    )
    for explanation, alternative, first in (
        (sign, backlash, "Calibrate with `--effects backlash`."),
        (sign, setup, "Look at the mounting of the gauge. "),
        (inches, point, "Take one of these readings again. "),
        (setup, other, "Look at the mounting of the gauge. If a minus sign was forgotten, reverse"),
    ):
        finding = describe_alternatives(session, explanation, alternative)
        assert finding.kind == "ambiguous"
        assert finding.action.startswith(first)


def test_a_wrong_reading_is_not_read_again_after_other_offsets_were_entered(session):
    second = session.with_controller(np.array([0.5e-3, -0.2e-3, 0.1e-3]))
    outlier, line = Explanation("outlier", "reading", rows=(4,)), session.readings[4].line
    for other, again in ((session.with_controller(np.zeros(3)), True), (second, False)):
        action = advise(join_sessions([session, replace(other, sha256="")]), outlier)
        assert (f"type `repeat {line}`" in action) == again
        assert ("Do not read it again" in action) != again
        assert f"`drop {line}` deletes it" in action


def test_a_setup_whose_gauge_may_have_moved_is_read_again(session):
    """Also the last one, whose stand is still there."""
    last = tuple(range(len(session.readings)))[-2:]
    names = (session.readings[last[0]].setup,)
    displaced = Explanation("displaced gauge", "reading", rows=last, names=names)
    sign = Explanation("reversed sign", "reading", rows=last[:1], factor=-1.0)
    finding = describe_alternatives(session, displaced, sign)
    assert f"type `restart {session.readings[last[0]].line}`" in finding.action


def test_the_same_line_of_another_file_is_named(session):
    first, second = (
        replace(session.readings[0], line=7, file=Path(name) / "readings.csv") for name in "ab"
    )
    joined = replace(session, readings=(first, second, session.readings[1]))
    both = Explanation("outlier", "posture", (0, 1))
    assert "type `repeat 7`, likewise the other lines." in advise_repetition(joined, both)
    sign = Explanation("reversed sign", "reading", (0,), factor=-1.0)
    _, one, several = describe_alternatives(joined, sign, both).text.splitlines()
    assert (one.count("line 7: "), several.count("line")) == (1, 0)
    log = replace(joined, firmware=DeltaSettings("klipper", 0.14, (0.28,) * 3, (0.5,) * 3))
    more = replace(log, readings=(*joined.readings, *(session.readings[1:2] * 4)))
    assert "Or leave out what is wrong, and calibrate again" in advise_repetition(more, both)


def test_lines_of_a_log_are_named_once_and_a_log_is_not_deleted(session):
    settings = DeltaSettings("klipper", 0.14, (0.28,) * 3, (0.5,) * 3)
    log = replace(session, firmware=settings)
    few = [Explanation("outlier", "reading", rows) for rows in ((1,), (0, 1))]
    lines = [session.readings[i].line for i in (0, 1)]
    assert f"delete lines {lines[0]}, {lines[1]} of readings.csv" in advise_repetition(log, *few)
    last = tuple(i for i, r in enumerate(session.readings) if r.setup == session.readings[0].setup)
    action = advise_repetition(log, Explanation("displaced gauge", "reading", last))
    assert "probe again" in action
    assert "delete" not in action


def test_changes_between_sessions_that_readings_do_not_distinguish_are_listed(session):
    drive = session.robot.drives[0].name
    missing, twice = (
        Explanation(kind, "session", drives=(drive,), sessions=("second",))
        for kind in ("offsets not entered", "offsets entered twice")
    )
    first, *listed = describe_alternatives(session, missing, twice).text.splitlines()
    assert first == "One of these may have happened:"
    assert [drive in line for line in listed] == [True, True]
