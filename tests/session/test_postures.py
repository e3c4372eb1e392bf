"""Postures of a session.yaml: the advice about their key can be followed."""

from __future__ import annotations

from dataclasses import replace

import pytest

from orthocal.errors import SessionError
from orthocal.measurement.files.session_drives import _read_posture
from orthocal.measurement.files.session_keys import PostureKeys


def advice(robot, key):
    with pytest.raises(SessionError) as refused:
        _read_posture(PostureKeys(**{key: [1.0, 2.0, 3.0]}), robot, "s.yaml: postures.a")
    return str(refused.value)


def test_a_key_that_is_refused_names_one_that_is_not(orthoglide):
    prismatic = orthoglide.drives
    revolute = tuple(replace(d, unit="rad") for d in prismatic)
    plane = replace(orthoglide.tcp, coordinates=(0, 1))
    of_joints = replace(orthoglide, drives=revolute, tcp=None)
    assert advice(of_joints, "tcp_mm").endswith("use joints_deg")
    assert advice(of_joints, "joints_mm").endswith("use joints_deg")
    mixed = replace(orthoglide, drives=(*prismatic[:2], revolute[2]))
    assert advice(mixed, "joints_mm").endswith("use tcp_mm")
    both = replace(mixed, tcp=plane)
    for key in ("tcp_mm", "joints_mm", "joints_deg"):
        assert "use tcp_mm" in advice(both, key)
        assert "orthocal.tcp.coordinates" in advice(both, key)
