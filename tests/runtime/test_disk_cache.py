"""Disk cache: content is trusted only if nobody else can have written it; failures are harmless."""

from __future__ import annotations

import os
import stat
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from conftest import load_afresh
from symbolic_robot import SymbolicRobot

from orthocal.kinematics.robot_functions import RobotFunctions
from orthocal.robot import urdf
from orthocal.robot.frames import Placement
from orthocal.runtime import disk_cache as cache

KEY = "a key"


@pytest.fixture
def folder(tmp_path, monkeypatch):
    path = tmp_path / "kept"
    monkeypatch.setenv(cache.VARIABLE, str(path))
    return path


def only_file(folder):
    (path,) = folder.glob("*.kept")
    return path


def test_content_is_returned_and_is_private(folder):
    assert cache.load(KEY) is None
    cache.store(KEY, b"content")
    assert cache.load(KEY) == b"content"
    assert cache.load(KEY + " of another") is None
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    assert stat.S_IMODE(only_file(folder).stat().st_mode) == 0o600


@pytest.mark.parametrize("value", ["off", "OFF", "0", "", "none"])
def test_the_cache_can_be_disabled(monkeypatch, tmp_path, value):
    monkeypatch.setenv(cache.VARIABLE, value)
    monkeypatch.chdir(tmp_path)
    cache.store(KEY, b"content")
    assert cache.cache_folder() is None
    assert cache.load(KEY) is None
    assert not list(tmp_path.iterdir())


def test_the_default_directory(monkeypatch, tmp_path):
    monkeypatch.delenv(cache.VARIABLE, raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cache.cache_folder() == tmp_path / "orthocal"
    monkeypatch.setenv("XDG_CACHE_HOME", "relative")
    monkeypatch.setenv("HOME", str(tmp_path))
    assert cache.cache_folder() == tmp_path / ".cache/orthocal"


def link_elsewhere(path):
    target = path.with_name(f"{path.name}-elsewhere")
    path.rename(target)
    path.symlink_to(target)


def replace_by_pipe(path):
    path.unlink()
    os.mkfifo(path, 0o600)


@pytest.mark.parametrize(
    "spoil", [lambda p: p.chmod(0o770), lambda p: p.chmod(0o702), link_elsewhere]
)
def test_an_untrusted_directory_is_not_used(folder, spoil):
    cache.store(KEY, b"content")
    spoil(folder)
    assert cache.load(KEY) is None
    cache.store("another", b"content")
    assert len(list(folder.iterdir())) == 1


def write_other_length(change):
    """Function that changes the content of a file, and its length."""
    return lambda path: path.write_bytes(change(path.read_bytes()))


@pytest.mark.parametrize(
    "spoil",
    [
        lambda p: p.chmod(0o620),
        link_elsewhere,
        replace_by_pipe,
        write_other_length(lambda b: b[:-1]),
        write_other_length(lambda b: b + b"!"),
        write_other_length(lambda b: b""),
    ],
)
def test_an_untrusted_file_is_not_used(folder, spoil):
    cache.store(KEY, b"content")
    spoil(only_file(folder))
    assert cache.load(KEY) is None


def test_a_directory_of_another_user_is_not_used(folder, monkeypatch):
    cache.store(KEY, b"content")
    monkeypatch.setattr(os, "geteuid", lambda: os.getuid() + 1)
    assert cache.load(KEY) is None


def test_a_changed_byte_is_noticed_and_the_file_replaced(folder):
    cache.store(KEY, b"content")
    path = only_file(folder)
    data = path.read_bytes()
    for i in range(len(data)):
        path.write_bytes(data[:i] + bytes([data[i] ^ 1]) + data[i + 1 :])
        assert cache.load(KEY) is None
    cache.store(KEY, b"content")
    assert cache.load(KEY) == b"content"


def test_a_file_of_another_key_is_not_trusted(folder):
    cache.store("another", b"of another")
    only_file(folder).rename(folder / cache._name(KEY))
    assert cache.load(KEY) is None


def test_the_size_is_bounded(folder, monkeypatch):
    monkeypatch.setattr(cache, "CHECKED", "")
    monkeypatch.setattr(cache, "LARGEST_TOTAL", 1000)
    for i in range(10):
        cache.store(f"key {i}", bytes(200))
        os.utime(folder / cache._name(f"key {i}"), (i, i))
    assert sum(p.stat().st_size for p in folder.iterdir()) <= 1000
    assert cache.load("key 9") is not None
    assert cache.load("key 0") is None
    monkeypatch.setattr(cache, "MOST_ENTRIES", 2)
    cache.store("key 10", b"")
    assert len(list(folder.iterdir())) == 2
    monkeypatch.setattr(cache, "LARGEST_ENTRY", 10)
    cache.store("key 11", bytes(11))
    assert cache.load("key 11") is None


def test_many_files_are_removed_now_and_then(folder, monkeypatch):
    monkeypatch.setattr(cache, "MOST_ENTRIES", 20)
    counts = []
    for i in range(200):
        cache.store(f"key {i}", b"")
        counts.append(len(list(folder.iterdir())))
    assert 20 < max(counts) < 100


def test_what_was_used_lately_is_kept(folder, monkeypatch):
    monkeypatch.setattr(cache, "CHECKED", "")
    monkeypatch.setattr(cache, "MOST_ENTRIES", 2)
    for i in range(2):
        cache.store(f"key {i}", b"")
        os.utime(folder / cache._name(f"key {i}"), (i, i))
    assert cache.load("key 0") is not None
    cache.store("key 2", b"")
    assert [cache.load(f"key {i}") for i in range(3)] == [b"", None, b""]


def test_a_failed_write_leaves_the_old_content(folder, monkeypatch):
    cache.store(KEY, b"old")

    def full(*args, **kwargs):
        raise OSError("disk full")

    monkeypatch.setattr(os, "rename", full)
    cache.store(KEY, b"new")
    assert cache.load(KEY) == b"old"
    assert len(list(folder.iterdir())) == 1


def test_a_missing_directory_is_harmless(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv(cache.VARIABLE, str(tmp_path / "file/kept"))
    cache.store(KEY, b"content")
    assert cache.load(KEY) is None
    assert load_afresh("orthoglide").name == "orthoglide"


def test_cached_functions_equal_built_ones(folder):
    built = RobotFunctions(load_afresh("orthoglide"))
    where = built.robot.drive_zero[None], built.robot.reference_passive[None]
    where = (*where, built.errors.placements(np.full(len(built.errors.names), 1e-3)))
    expected = built.closure_jacobian(*where)
    assert list(folder.glob("*.kept"))
    for path in folder.glob("*.kept"):
        path.touch()
    kept = RobotFunctions(load_afresh("orthoglide"))
    kept.tree.frame_pose = None  # nothing is built: no expression is made
    for ours, theirs in zip(kept.closure_jacobian(*where), expected, strict=True):
        assert np.array_equal(ours, theirs)


@pytest.mark.parametrize(
    "change",
    [
        lambda r: r.with_errors({"x_coupler.x": 9e-3}).with_tolerances({"*.offset_mm": 3.0}),
        # a frame without errors that carries one with errors
        lambda r: r.displaced({Placement(r.frame_id("platform_mount"), True): np.full(6, 0.1)}),
    ],
)
def test_machines_of_other_dimensions_and_tolerances_share_functions(folder, orthoglide, change):
    _ = RobotFunctions(orthoglide).closure_jacobian.layout
    files = sorted(folder.glob("*.kept"))
    machine = change(orthoglide)
    shared = RobotFunctions(machine)
    where = machine.drive_zero[None], np.full((1, machine.passive_index.size), 0.1)
    where = (*where, shared.errors.placements(np.zeros(len(shared.errors.names))))
    ours = shared.closure_jacobian(*where)
    assert sorted(folder.glob("*.kept")) == files
    plain = SymbolicRobot(machine, drives=ca.SX(machine.drive_zero), passive=ca.SX(where[1][0]))
    theirs = plain.closure_residual()
    assert np.allclose(ours[0][0], np.array(ca.DM(theirs))[:, 0], rtol=0.0, atol=1e-12)


@pytest.mark.parametrize(
    "change",
    [
        lambda r: replace(r, closures=r.closures[1:], constraints=r.constraints[1:]),
        lambda r: replace(r, closures=tuple(replace(c, rows=c.rows[:1]) for c in r.closures)),
        lambda r: replace(r, tcp=None),
    ],
)
def test_functions_depend_on_all_that_is_not_an_input(orthoglide, change):
    assert RobotFunctions(change(orthoglide)).digest != RobotFunctions(orthoglide).digest


def test_yourdfpy_checks_the_same_content_once(folder, monkeypatch):
    asked = []
    ask = urdf._run_yourdfpy
    monkeypatch.setattr(urdf, "_run_yourdfpy", lambda text, path: asked.append(ask(text, path)))
    load_afresh("orthoglide")
    assert len(asked) == 1
    load_afresh("orthoglide")
    assert len(asked) == 1
    for path in folder.glob("*.kept"):
        path.write_bytes(path.read_bytes() + b" ")
    load_afresh("orthoglide")
    assert len(asked) == 2
