"""Gauges of tests: known exactly, or of different noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from orthocal.sensors.mounting import EXACT


def exact(session):
    """The same session, or plan, with nothing unknown of its gauges but their zeros."""
    setups = {
        name: replace(s, sensor=replace(s.sensor, mounting=EXACT))
        if hasattr(s.sensor, "mounting")
        else s
        for name, s in session.setups.items()
    }
    return replace(session, setups=setups)


def with_gauges(session, gauges, fine_setups):
    """The same session with two gauges, by name: "fine" of some setups and "coarse" of the others.

    The first gauge of the session is the first of `gauges`.
    """
    setups = {
        name: replace(s, gauge="fine" if name in fine_setups else "coarse")
        for name, s in session.setups.items()
    }
    return replace(session, gauges=gauges, setups=setups)


def with_scatter(session, theta, problem, rng):
    """The session with readings of a machine, each with the stated noise of its gauge.

    `theta` are the free parameters of the problem, [SI].
    """
    sigmas = [session.gauges[s.gauge].sigma for s in session.setups.values()]
    scatter = rng.normal(size=problem.observations.size)
    entries = problem.predict(theta) + scatter * np.array(sigmas)[problem.observations.setup]
    return session.with_values(problem.observations.rows(entries))
