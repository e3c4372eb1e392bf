"""Gauges of tests that are about the machine alone: known exactly, where and how they stand."""

from __future__ import annotations

from dataclasses import replace

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
