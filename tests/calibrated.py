"""Plans, sessions, calibrations, scenes and reports of the examples, cached in a process."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

from conftest import ROOT
from folders import session_folder

from orthocal import calibrate, draw_scene, load_plan, load_session
from orthocal.assessment.judgement import Judgement
from orthocal.calibration.identify import identify
from orthocal.estimation.tolerance_scale import AS_STATED
from orthocal.output.report.page import build_report

EXPERIMENT_2 = "table1/experiment-2"

SOUND = Judgement((), AS_STATED)
"""Judgement of readings without anomalies, of a machine within its tolerances."""

UNJUDGED = {"solver": "variable-projection", "judgement": SOUND}
"""Options of a calibration whose readings are assumed sound; a judged one needs twice the time."""


@cache
def plan_of(name):
    """Plan of an example, or of a directory in tests/sessions."""
    return load_plan(session_folder(ROOT, name) / "plan.yaml")


@cache
def session_of(name):
    """Session of an example, or of a directory in tests/sessions."""
    return load_session(session_folder(ROOT, name))


@cache
def calibrated(name, model=None, **options):
    """Calibration of an example with a model; by default the model of its session."""
    return calibrate(session_of(name), model, **options)


def identified(sessions, choice=None, *, solver="variable-projection", **options):
    """Calibration without assessment: a third of the time of a complete one."""
    return identify(sessions, choice, solver=solver, **options)[0]


@cache
def scene_of(name, model=None, **options):
    """Scene of the calibration of an example; tests do not change it."""
    return draw_scene(calibrated(name, model), **options)


@cache
def report_of(name, model=None):
    """Report of the calibration of an example."""
    return build_report(calibrated(name, model))


def rename_setups(session, names):
    """The session with other names of its setups, each by its old name."""
    return replace(
        session,
        setups={
            names.get(n, n): replace(s, name=names.get(n, n)) for n, s in session.setups.items()
        },
        readings=tuple(replace(r, setup=names.get(r.setup, r.setup)) for r in session.readings),
    )
