"""Both backends of batch functions give the same numbers, bit by bit."""

from __future__ import annotations

from pathlib import Path

import casadi as ca
import numpy as np
import pytest

from orthocal import load_plan
from orthocal.kinematics import function_cache
from orthocal.kinematics.backend import batch_function, llvm
from orthocal.kinematics.backend.batch_function import BatchFunction
from orthocal.kinematics.robot_functions import robot_functions
from orthocal.observation.observations import build_observations
from orthocal.observation.sensor_groups import group_sensors

BACKENDS = ("casadi", "llvm")


def points(robot, count):
    rng = np.random.default_rng(0)
    errors = robot_functions(robot).errors
    drives = robot.drive_zero + 0.02 * rng.normal(size=(count, len(robot.drives)))
    passive = robot.reference_passive
    passive = passive + 0.2 * rng.normal(size=(count, passive.size))
    return drives, passive, errors.placements(1e-2 * rng.normal(size=len(errors.names)))


def assert_same(found, expected):
    for ours, theirs in zip(found, expected, strict=True):
        assert ours.shape == theirs.shape
        assert np.array_equal(ours, theirs, equal_nan=True)


@pytest.mark.parametrize("name", ["orthoglide", "fivebar", "biglide"])
@pytest.mark.parametrize("count", [0, 1, *llvm.LANES, llvm.LANES[0] + 1, 2 * llvm.LANES[-1] + 1])
def test_both_backends_give_the_same_numbers(request, name, count):
    robot = request.getfixturevalue(name)
    functions, where = robot_functions(robot), points(robot, count)
    tested = [functions.closure_by_passive, functions.closure_jacobian]
    if robot.tcp is not None:
        tested += [functions.closure_and_tool, functions.tool_jacobian]
    for function in tested:
        found, expected = (function(*where, backend=b) for b in BACKENDS)
        assert_same(found, expected)
        assert_same(function(*where), expected)


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_row_of_an_input_holds_for_successive_points(orthoglide, backend):
    function, where = robot_functions(orthoglide).closure_by_passive, points(orthoglide, 44)
    rng = np.random.default_rng(3)
    for rows in (1, 11, 44):
        placements = where[2] + 1e-4 * rng.normal(size=(rows, where[2].size))
        repeated = np.repeat(placements, 44 // rows, axis=0)
        expected = function(*where[:2], repeated, backend=backend)
        assert_same(function(*where[:2], placements, backend=backend), expected)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("shapes", [
    ((5, 3), (2, 2)), ((4, 3), (3, 2)), ((5, 1), (1, 2)), ((5, 2), (1, 2)), ((5, 3),),
    ((1, 5, 3), (1, 2)),
])  # fmt: skip
def test_inputs_of_other_shapes_are_refused(shapes, backend):
    x, y = ca.SX.sym("x", 3), ca.SX.sym("y", 2)
    batch = BatchFunction(ca.Function("f", [x, y], [ca.dot(x, x) * y]))
    with pytest.raises(ValueError, match="expected 3, 2 columns"):
        batch(*map(np.ones, shapes), backend=backend)


@pytest.mark.parametrize("count", [*(n - 3 for n in llvm.LANES), 101])
def test_every_operation_is_casadis(count):
    x, y = ca.SX.sym("x"), ca.SX.sym("y")
    results = [
        *(x + y, x - y, x * y, x / y, -x, x**2, 2.0 * x, 1.0 / x, ca.sqrt(ca.fabs(x)), ca.sin(x)),
        *(ca.cos(x), ca.tan(x), ca.asin(x / 9), ca.acos(x / 9), ca.atan(x), ca.atan2(x, y)),
        *(x < y, x <= y, x == y, x != y, ca.logic_not(x), ca.logic_and(x, y)),
        *(ca.logic_or(x, y), ca.if_else(x < y, x, y), ca.sign(x), ca.SX(3.5), x),
    ]
    function = ca.Function("all", [x, y], [ca.densify(ca.vertcat(*results))])
    assert llvm.list_instructions(function) is not None
    rng = np.random.default_rng(1)
    values = rng.normal(size=(2, 101, 1))
    values[1, ::3], values[0, ::5] = values[0, ::3], 0.0
    values[1, ::10] = 0.0
    values = values[:, :count]
    batch = BatchFunction(function)
    assert_same(*(batch(*values, backend=b) for b in BACKENDS))


@pytest.mark.parametrize("example", ["raw-cycles", "workshop"])
def test_the_instructions_of_all_readings_are_known(root, example):
    """Line between rods, and ball on a rod: others would be evaluated ten times slower."""
    session = load_plan(root / "examples" / example / "plan.yaml")
    for group in group_sensors(session, build_observations(session)):
        for batch in (group.reading.value, group.reading.jacobian):
            assert llvm.list_instructions(batch.function) is not None


def test_a_function_with_an_unknown_instruction_is_evaluated_by_casadi():
    x = ca.SX.sym("x")
    function = ca.Function("unknown", [x], [ca.erf(x)])
    assert llvm.list_instructions(function) is None
    (found,) = BatchFunction(function)(np.ones((50, 1)), backend="llvm")
    assert found[0, 0] == float(ca.erf(1.0))


@pytest.mark.parametrize("installed", [True, False])
def test_the_backend_depends_on_the_call_alone(orthoglide, monkeypatch, installed):
    batch, enough = robot_functions(orthoglide).closure_by_passive, batch_function.MIN_POINTS
    assert batch.function.n_instructions() * enough > batch_function.MIN_OPERATIONS
    used = []
    monkeypatch.setattr(llvm, "is_installed", lambda: installed)
    monkeypatch.setattr(llvm, "run", lambda *_: used.append("llvm"))
    for count, expected in ((enough, installed), (enough - 1, False), (enough, installed)):
        used.clear()
        batch(*points(orthoglide, count))
        assert bool(used) == expected


def test_casadi_evaluates_where_the_interpreter_cannot_be_compiled(orthoglide, monkeypatch):
    function, where = robot_functions(orthoglide).closure_by_passive, points(orthoglide, 3)
    expected = function(*where, backend="casadi")
    monkeypatch.setattr(llvm, "compile_interpreter", lambda _: None)
    assert_same(function(*where, backend="llvm"), expected)


def test_instructions_are_cached_on_disk(orthoglide, tmp_path, monkeypatch):
    monkeypatch.setenv("ORTHOCAL_CACHE", str(tmp_path / "cache"))
    function = robot_functions(orthoglide).closure_by_passive.function
    sizes = function.n_instructions(), function.n_out()
    assert llvm.load_program("a key", *sizes) is None
    expected = llvm.list_instructions(function)
    llvm.store_program("a key", expected)
    found = llvm.load_program("a key", *sizes)
    assert found.n_work == expected.n_work
    for name in ("table", "constants", "output_starts"):
        ours, theirs = getattr(found, name), getattr(expected, name)
        assert ours.dtype == theirs.dtype
        assert np.array_equal(ours, theirs)
    # content of another length is not used, whatever its checksum says
    assert llvm.load_program("a key", sizes[0] + 1, sizes[1]) is None
    assert llvm.load_program("a key", sizes[0], sizes[1] + 1) is None


def test_a_large_function_is_loaded_only_for_casadi(orthoglide, tmp_path, monkeypatch):
    monkeypatch.setenv("ORTHOCAL_CACHE", str(tmp_path / "cache"))
    original, where = robot_functions(orthoglide).closure_jacobian, points(orthoglide, 20)
    assert original.layout.n_instructions > llvm.MIN_CACHED
    loaded = []

    def load():
        loaded.append(True)
        return original.function

    def fresh():
        return BatchFunction(load, matrices=["y1", "y2"], sparse=["y3"], key="a key")

    expected = original(*where, backend="casadi")
    for times in (1, 1):  # the first call stores layout and instructions
        batch = fresh()
        assert_same(batch(*where, backend="llvm"), expected)
        for ours, theirs in zip(batch.patterns["y3"], original.patterns["y3"], strict=True):
            assert np.array_equal(ours, theirs)
        assert len(loaded) == times
    assert_same(fresh()(*where, backend="casadi"), expected)
    assert len(loaded) == 2


def test_a_small_function_is_not_cached(tmp_path, monkeypatch):
    monkeypatch.setenv("ORTHOCAL_CACHE", str(tmp_path / "cache"))
    x = ca.SX.sym("x")
    batch = BatchFunction(lambda: ca.Function("small", [x], [2.0 * x]), key="a key")
    assert_same(batch([[3.0]], backend="llvm"), (np.array([[6.0]]),))
    assert not (tmp_path / "cache").exists()


def test_a_change_of_the_backend_changes_the_keys_of_cached_functions(monkeypatch):
    before, read = function_cache._code(), Path.read_bytes
    changed = {Path(llvm.__file__), Path(batch_function.__file__)}
    monkeypatch.setattr(
        Path, "read_bytes", lambda path: read(path) + b"#" if path in changed else read(path)
    )
    assert function_cache._code.__wrapped__() != before
