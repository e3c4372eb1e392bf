"""Cache of a robot's CasADi functions, in memory and on disk.

The key of a function covers what it depends on, the code that builds functions, and the versions of
CasADi and Pinocchio.
"""

from __future__ import annotations

import hashlib
import sys
import uuid
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import lru_cache, wraps
from importlib.metadata import version
from pathlib import Path
from typing import TypeVar

import casadi as ca

from orthocal.effects.loading import robot_effects
from orthocal.robot.model import Robot
from orthocal.runtime import disk_cache

Result = TypeVar("Result")

MAX_FUNCTIONS = 256
"""Largest number of functions in memory; one needs up to 2 MB."""

MAX_ROBOTS = 8
"""Largest number of robots for which the results of a function are in memory."""

OPTIONS = {"cse": True}
"""CasADi options of large functions: compute common subexpressions once."""

_CODE_DIRECTORIES = (
    "kinematics",
    "kinematics/backend",
    "sensors",
    "robot",
    "effects",
    "estimation",
    "estimation/solvers",
)
"""Directories of orthocal with code that builds functions or lists their instructions."""


@dataclass(frozen=True, slots=True)
class _Recipe:
    """Key of a function and a callable that builds it; recipes with the same key are equal."""

    key: str
    build: Callable[[], ca.Function] = field(compare=False)


def function_key(name: str, *contents: str) -> str:
    """Key of a function.

    Args:
        name: Name of the function, unique among those with the same contents.
        contents: Digests of all that the function depends on, such as `fingerprint`.
    """
    return "\n".join((f"function {name}", *contents, _code()))


def cached_function(key: str, build: Callable[[], ca.Function]) -> ca.Function:
    """Load a function from memory or disk, or build it.

    Args:
        key: Key of the function (see `function_key`).
        build: Builds the function.
    """
    return _load_or_build(_Recipe(key, build))


@lru_cache(maxsize=MAX_FUNCTIONS)
def _load_or_build(recipe: _Recipe) -> ca.Function:
    """Load a function from disk, or build and store it."""
    function = _load(recipe.key)
    if function is None:
        function = recipe.build()
        _save(recipe.key, function)
    return function


def _load(key: str) -> ca.Function | None:
    """Load a function from disk; None if it is absent or unreadable."""
    content = disk_cache.load(key)
    if content is None:
        return None
    try:
        return ca.Function.deserialize(content.decode("ascii"))
    except (RuntimeError, ValueError):  # written by another build of CasADi
        return None


def _save(key: str, function: ca.Function) -> None:
    """Store a function on disk if it can be serialised."""
    try:
        text = function.serialize()
    except RuntimeError:  # some functions cannot be serialised
        return
    disk_cache.store(key, text.encode("ascii"))


@dataclass(frozen=True, slots=True)
class _RobotKey:
    """Robot as key of a cache; robots with the same identity are equal."""

    identity: tuple[str, str]
    """Result of `identify`."""
    robot: Robot = field(compare=False)
    """The robot, for a call that is not cached."""


def cached_per_robot(function: Callable[[Robot], Result]) -> Callable[[Robot], Result]:
    """Cache the results of a function of a robot; robots of equal identity share a result."""
    cached = lru_cache(MAX_ROBOTS)(lambda key: function(key.robot))

    @wraps(function)
    def look_up(robot: Robot) -> Result:
        return cached(_RobotKey(identify(robot), robot))

    return look_up


def identify(robot: Robot) -> tuple[str, str]:
    """Identity of a robot: its fingerprint and its YAML file, which messages name."""
    return fingerprint(robot), str(robot.yaml)


@lru_cache(maxsize=16)
def fingerprint(robot: Robot) -> str:
    """Digest of all properties of a robot on which its functions depend."""
    parts = [
        robot.model.saveToString(),
        repr(robot.closures),
        repr(robot.drives),
        repr((robot.tcp, robot.bed)),
        repr(robot.legs),
        repr([d.hex() for d in robot.reference_posture.tolist()]),
        repr(robot.drive_index.tolist()),
        repr(robot.passive_index.tolist()),
        repr([float(v).hex() for v in robot.drive_gain]),
        repr(tuple(robot.parameters.elementary.values())),
        repr([(name, robot.declared.effects.get(name)) for name in robot.effect_names]),
        repr(robot.declared.adjustments) if robot.adjusted else "",
        *(source_digest(type(e)) for e in robot_effects(robot)),  # type: ignore[arg-type] # hashable
        repr([(p.name, p.terms) for p in robot.parameters]),
        repr(robot.declared.models),
    ]
    return hashlib.sha256("\0".join(parts).encode()).hexdigest()


@lru_cache(maxsize=64)
def source_digest(kind: type) -> str:
    """Digest of the source file of a class outside orthocal; "" for classes of orthocal.

    A class without a file, such as one in a notebook, has a new digest in each process.
    """
    if kind.__module__.startswith("orthocal."):
        return ""
    file = getattr(sys.modules.get(kind.__module__), "__file__", None)
    try:
        content = Path(file or "").read_bytes()
    except OSError:
        return uuid.uuid4().hex
    return hashlib.sha256(content).hexdigest()


@lru_cache(maxsize=1)
def _code() -> str:
    """Versions of the libraries and a digest of the code that builds functions."""
    digest = hashlib.sha256()
    root = Path(__file__).parents[1]
    for directory in _CODE_DIRECTORIES:
        for path in sorted((root / directory).glob("*.py")):
            digest.update(path.name.encode() + b"\0" + path.read_bytes() + b"\0")
    versions = f"casadi {version('casadi')} pinocchio {version('pin')}"
    return f"{versions} code {digest.hexdigest()}"
