"""CasADi functions of a robot, built once, and kept on disk.

They are kept by all that they depend on: the robot as it was loaded, the code that builds them, and
the versions of CasADi and Pinocchio.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from functools import lru_cache, wraps
from importlib.metadata import version
from pathlib import Path
from typing import TypeVar

import casadi as ca
import numpy as np

from orthocal.robot.model import Robot
from orthocal.runtime import disk_cache as cache

Made = TypeVar("Made")

MOST_RECENT = 256
"""Functions that a process keeps; one takes up to 2 MB."""

_RECENT: dict[str, ca.Function] = {}

_BUILT_BY = ("kinematics", "sensors", "robot", "estimation", "estimation/solvers")
"""Folders with the code that builds functions."""


def kept_function(robot: Robot, name: str, build: Callable[[], ca.Function]) -> ca.Function:
    """A function of a robot: as kept on disk, or built and kept.

    Args:
        robot: The robot.
        name: Of the function, and all that distinguishes it from others of the robot.
        build: Builds it.
    """
    key = f"function {name}\n{fingerprint(robot)}\n{_code()}"
    if key not in _RECENT:
        function = _recall(key)
        if function is None:
            function = build()
            _keep(key, function)
        if len(_RECENT) >= MOST_RECENT:
            _RECENT.pop(next(iter(_RECENT)))
        _RECENT[key] = function
    return _RECENT[key]


def known_as(function: ca.Function) -> str | None:
    """By what a function is kept in this process; None for others."""
    same = (key for key, kept in _RECENT.items() if kept.__hash__() == function.__hash__())
    return next(same, None)


def _recall(key: str) -> ca.Function | None:
    content = cache.load(key)
    if content is None:
        return None
    try:
        return ca.Function.deserialize(content.decode("ascii"))
    except (RuntimeError, ValueError):  # of a casadi that was built otherwise
        return None


def _keep(key: str, function: ca.Function) -> None:
    try:
        text = function.serialize()
    except RuntimeError:  # some cannot be written
        return
    cache.store(key, text.encode("ascii"))


class _Content:
    """A robot that equals any other that moves, and is described, alike."""

    __slots__ = ("key", "robot")

    def __init__(self, robot: Robot) -> None:
        self.robot, self.key = robot, identify(robot)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Content) and self.key == other.key

    def __hash__(self) -> int:
        return hash(self.key)


def once_a_robot(
    maxsize: int,
) -> Callable[[Callable[[Robot], Made]], Callable[[Robot], Made]]:
    """Decorate a function of a robot: robots that are the same share what it makes.

    Args:
        maxsize: Robots whose things are kept.
    """

    def decorate(make: Callable[[Robot], Made]) -> Callable[[Robot], Made]:
        made = lru_cache(maxsize)(lambda content: make(content.robot))

        @wraps(make)
        def find(robot: Robot) -> Made:
            return made(_Content(robot))

        return find

    return decorate


def identify(robot: Robot) -> tuple[str, str]:
    """Equal for robots that move alike and are named alike in messages."""
    return fingerprint(robot), str(robot.yaml)


@lru_cache(maxsize=16)
def fingerprint(robot: Robot) -> str:
    """A digest of all that a robot's functions depend on."""
    parts = [
        robot.model.saveToString(),
        repr(robot.closures),
        repr(robot.drives),
        repr(robot.tcp),
        repr(
            [
                (leg.name, leg.root, leg.tip, leg.root_driven, np.asarray(leg.axis).tolist())
                for leg in robot.legs.values()
            ]
        ),
        repr([d.hex() for d in robot.zero.tolist()]),
        repr(robot.drive_index.tolist()),
        repr(robot.passive_index.tolist()),
        repr([float(v).hex() for v in robot.drive_gain]),
        repr(tuple(robot.parameters.elementary.values())),
        repr([(p.name, p.terms) for p in robot.parameters]),
        float(robot.characteristic_length).hex(),
    ]
    return hashlib.sha256("\0".join(parts).encode()).hexdigest()


@lru_cache(maxsize=1)
def _code() -> str:
    """Versions, and a digest of the code that builds functions."""
    digest = hashlib.sha256()
    root = Path(__file__).parents[1]
    for folder in _BUILT_BY:
        for path in sorted((root / folder).glob("*.py")):
            digest.update(path.name.encode() + b"\0" + path.read_bytes() + b"\0")
    versions = f"casadi {version('casadi')} pinocchio {version('pin')}"
    return f"{versions} code {digest.hexdigest()}"
