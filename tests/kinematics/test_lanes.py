"""Functions run in lanes give the numbers that CasADi gives, bit by bit."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from orthocal import load_plan
from orthocal.kinematics.backend import lanes
from orthocal.kinematics.backend.batch_function import BatchFunction
from orthocal.kinematics.backend.lanes import Way, list_instructions, running
from orthocal.kinematics.compiled import compiled_robot
from orthocal.observation.observations import build_observations
from orthocal.observation.sensor_groups import group_sensors


def points(robot, count):
    rng = np.random.default_rng(0)
    errors = compiled_robot(robot).errors
    drives = robot.drive_zero + 0.02 * rng.normal(size=(count, len(robot.drives)))
    passive = robot.zero[robot.passive_index]
    passive = passive + 0.2 * rng.normal(size=(count, passive.size))
    return drives, passive, errors.placements(1e-2 * rng.normal(size=len(errors.names)))


@pytest.mark.parametrize("name", ["orthoglide", "fivebar", "biglide"])
@pytest.mark.parametrize("count", [1, 8, 9, 33])
def test_both_ways_give_the_same_numbers(request, name, count):
    robot = request.getfixturevalue(name)
    compiled, where = compiled_robot(robot), points(robot, count)
    functions = [compiled.closing, compiled.slopes]
    if robot.tcp is not None:
        functions += [compiled.inverting, compiled.tool]
    for function in functions:
        with running(Way.CASADI):
            expected = function(*where)
        with running(Way.LLVM):
            found = function(*where)
        for ours, theirs in zip(found, expected, strict=True):
            assert ours.shape == theirs.shape
            assert np.array_equal(ours, theirs)


def test_inputs_of_their_own_are_the_same_as_shared_ones(orthoglide):
    function, where = compiled_robot(orthoglide).closing, points(orthoglide, 40)
    own = (*where[:2], np.tile(where[2], (40, 1)))
    for way in (Way.CASADI, Way.LLVM):
        with running(way):
            for a, b in zip(function(*where), function.unshared(*own), strict=True):
                assert np.array_equal(a, b)


@pytest.mark.parametrize("count", [lanes.SHORT - 3, 101])
def test_every_operation_is_casadis(count):
    x, y = ca.SX.sym("x"), ca.SX.sym("y")
    found = [
        *(x + y, x - y, x * y, x / y, -x, x**2, 2.0 * x, 1.0 / x, ca.sqrt(ca.fabs(x)), ca.sin(x)),
        *(ca.cos(x), ca.tan(x), ca.asin(x / 9), ca.acos(x / 9), ca.atan(x), ca.atan2(x, y)),
        *(x < y, x <= y, x == y, x != y, ca.logic_not(x), ca.logic_and(x, y)),
        *(ca.logic_or(x, y), ca.if_else(x < y, x, y), ca.sign(x), ca.SX(3.5), x),
    ]
    function = ca.Function("all", [x, y], [ca.densify(ca.vertcat(*found))])
    assert list_instructions(function) is not None
    rng = np.random.default_rng(1)
    values = rng.normal(size=(2, 101, 1))
    values[1, ::3], values[0, ::5] = values[0, ::3], 0.0
    values[1, ::10] = 0.0
    values = values[:, :count]
    batch = BatchFunction(function)
    with running(Way.CASADI):
        (expected,) = batch(*values)
    with running(Way.LLVM):
        (ours,) = batch(*values)
    assert np.array_equal(ours, expected, equal_nan=True)


@pytest.mark.parametrize("example", ["raw-cycles", "workshop"])
def test_what_gauges_read_is_all_known(root, example):
    """Of the line between rods, and of a ball on one: else large sessions take twice as long."""
    session = load_plan(root / "examples" / example / "plan.yaml")
    for group in group_sensors(session, build_observations(session)):
        for function in (group.reading.value, group.reading.slopes):
            assert list_instructions(function._function) is not None


def test_an_operation_that_is_not_known_is_left_to_casadi():
    x = ca.SX.sym("x")
    function = ca.Function("unknown", [x], [ca.erf(x)])
    assert list_instructions(function) is None
    with running(Way.LLVM):
        (found,) = BatchFunction(function)(np.ones((50, 1)))
    assert found[0, 0] == float(ca.erf(1.0))


def test_a_row_of_an_input_stands_for_points_in_turn(orthoglide):
    function, where = compiled_robot(orthoglide).closing.unshared, points(orthoglide, 44)
    rng = np.random.default_rng(3)
    rows = where[2] + 1e-4 * rng.normal(size=(11, where[2].size))
    for way in (Way.CASADI, Way.LLVM):
        with running(way):
            expected = function(*where[:2], np.repeat(rows, 4, axis=0))
            for a, b in zip(function(*where[:2], rows), expected, strict=True):
                assert np.array_equal(a, b)


def test_no_points_are_none(orthoglide):
    function, where = compiled_robot(orthoglide).closing, points(orthoglide, 3)
    with running(Way.LLVM):
        found = function(where[0][:0], where[1][:0], where[2])
    assert [len(a) for a in found] == [0, 0]


def test_nothing_is_made_for_little(monkeypatch):
    monkeypatch.setattr(lanes, "_spent", 0.0)
    monkeypatch.setattr(lanes, "is_installed", lambda: True)
    much = int(lanes.PATIENCE / 400)
    assert not lanes.pays(much - 1, 400, before=101)  # in all
    assert not lanes.pays(much, 400, before=50)  # of this function
    assert not lanes.pays(much, 400, before=50, is_listed=lambda: False)
    assert lanes.pays(much, 400, before=50, is_listed=lambda: True)
    assert not lanes.pays(much, lanes.FEWEST - 1, before=50, is_listed=lambda: True)
    assert lanes.pays(1, 400, before=101)
    assert not lanes.pays(much, lanes.FEWEST - 1, before=10**6)
    monkeypatch.setattr(lanes, "is_installed", lambda: False)
    assert not lanes.pays(20_000, 10**9, before=0)


def test_where_there_is_no_interpreter_casadi_does_it(orthoglide, monkeypatch):
    function, where = compiled_robot(orthoglide).closing, points(orthoglide, 3)
    with running(Way.LLVM):
        expected = function(*where)
        monkeypatch.setattr(lanes, "interpreter", lambda _: None)
        for a, b in zip(function(*where), expected, strict=True):
            assert np.array_equal(a, b)


def test_instructions_are_kept_on_disk(orthoglide, tmp_path, monkeypatch):
    monkeypatch.setenv("ORTHOCAL_CACHE", str(tmp_path / "kept"))
    function = compiled_robot(orthoglide).closing._function
    assert function.n_instructions() > lanes.FEWEST_KEPT
    expected = list_instructions(function)
    made = []

    def counted(function):
        made.append(function)
        return list_instructions(function)

    monkeypatch.setattr(lanes, "list_instructions", counted)
    for _ in range(3):
        found = lanes.find_listing(function)
        assert len(made) == 1
        assert found.n_work == expected.n_work
        for name in ("table", "constants", "first_out"):
            ours, theirs = getattr(found, name), getattr(expected, name)
            assert ours.dtype == theirs.dtype
            assert np.array_equal(ours, theirs)
    # what is of another length is not taken, whatever its checksum says
    content = lanes.cache.load
    monkeypatch.setattr(lanes.cache, "load", lambda key: content(key)[:-8])
    assert np.array_equal(lanes.find_listing(function).table, expected.table)
    assert len(made) == 2


def test_what_was_listed_before_is_run_in_lanes_at_once(orthoglide, tmp_path, monkeypatch):
    monkeypatch.setenv("ORTHOCAL_CACHE", str(tmp_path / "kept"))
    monkeypatch.setattr(lanes, "_spent", 2.0 * lanes.PATIENCE)
    kept, where = compiled_robot(orthoglide).closing._function, points(orthoglide, 5)
    shared = (kept.name_in(2),)

    def runs_in_lanes():
        function = BatchFunction(kept, shared=shared)
        monkeypatch.setattr(function, "_by_casadi", lambda *_: pytest.fail("by CasADi"))
        try:
            function(*where)
        except pytest.fail.Exception:
            return False
        return True

    assert not runs_in_lanes()
    lanes.find_listing(kept)
    assert runs_in_lanes()
