"""A simulator of Orthoglides that shares no formula with orthocal: NumPy and SciPy on rigid bodies.

Errors displace placements (`expm`), Newton's method with finite differences closes the loops, and
readings are where lines meet. Arrays begin with the machines, M, and the states, K.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from dataclasses import dataclass

import numpy as np
import yaml
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

CLOSED = 1e-13
"""[m, rad] Loops that are left open."""

ROUNDING = 1e-11
"""[m, rad] What is left open below this by rounding."""

STEP = 1e-6
"""[m, rad] Of finite differences."""


@dataclass(frozen=True)
class Expansion:
    """Stated thermal expansion, [1/K], and the temperature at which dimensions hold, [°C]."""

    legs: float = 11.5e-6
    screws: float = 11.5e-6
    reference: float = 20.0


@dataclass(frozen=True)
class States:
    """Commanded postures with their conditions."""

    drives: np.ndarray
    """Shape (K, 3), [m]."""
    approach: np.ndarray
    """Shape (K, 3): 1 where the coordinate grew in the last motion, -1 where it fell, or 0."""
    temperature: np.ndarray
    """Shape (K,), [°C]."""
    stretch: np.ndarray | float = 0.0
    """Changes of the rods' lengths under load, shape (K, 6), [m]."""


@dataclass(frozen=True)
class Gauge:
    """An indicator on a leg: line of the leg, or ball on a rod; lengths in m."""

    leg: str
    direction: np.ndarray
    fraction: float
    rod: str | None = None
    radius: float = 0.0
    """Of rod and ball together."""


@dataclass
class Joint:
    """Joint of the URDF: nominal placement in its parent, axis and type."""

    name: str
    kind: str
    parent: str
    child: str
    rotation: np.ndarray
    position: np.ndarray
    axis: np.ndarray


def twist_matrix(twist):
    """4 × 4 matrices of twists, shape (..., 4, 4) of (..., 6)."""
    result = np.zeros((*twist.shape[:-1], 4, 4))
    x, y, z = (twist[..., 3 + i] for i in range(3))
    result[..., 0, 1], result[..., 0, 2], result[..., 1, 2] = -z, y, -x
    result[..., 1, 0], result[..., 2, 0], result[..., 2, 1] = z, -y, x
    result[..., :3, 3] = twist[..., :3]
    return result


class IndependentMachine:
    """One or many Orthoglides with errors (numbers, or values of M machines) and effects, [SI].

    `active` are the offsets active in the controller while the gauges were mounted.
    """

    def __init__(self, folder, errors, *, lead=5e-3, expansion=None, active=0.0):
        self.folder, self.active = folder, active
        (urdf,) = folder.glob("*.urdf")
        (about,) = (yaml.safe_load(f.read_text()) for f in folder.glob("*.yaml"))
        self.about, self.lead, self.expansion = about["orthocal"], lead, expansion
        self.pairs = list(zip(about["closed_loop"], about["type"], strict=True))
        self.drives = about["name_mot"]
        self.joints = [_read_joint(j) for j in ET.parse(urdf).getroot().iter("joint")]
        self.passive = [
            j.name for j in self.joints if j.kind == "revolute" and j.name not in self.drives
        ]
        values = {n: np.atleast_1d(np.asarray(v, dtype=float)) for n, v in errors.items()}
        self.count = max((v.size for v in values.values()), default=1)
        self.errors = {n: np.broadcast_to(v, (self.count,)) for n, v in values.items()}
        self.length = float(
            np.linalg.norm(next(j.position for j in self.joints if j.name == "x_coupler"))
        )
        self._displace()

    def error(self, name):
        """Values of a parameter for all machines, shape (M,), [SI]."""
        return self.errors.get(name, np.zeros(self.count))

    def _joint(self, name):
        return next(
            j for j in self.joints if name in (j.name, j.child if j.kind == "fixed" else "")
        )

    def _displace(self):
        """Placements with errors, and their derivative by a growth of the rod along its axis."""
        self.placed, self.grown = {}, {}
        tips = {name for k in "xyz" for name in (f"{k}_coupler", f"{k}_rod_b_tip")}
        for j in self.joints:
            key = f"frame.{j.child}" if j.kind == "fixed" else j.name
            twist = np.stack([self.error(f"{key}.{a}") for a in ("x", "y", "z")], axis=-1)
            turn = np.stack([self.error(f"{key}.{a}") for a in ("rx", "ry", "rz")], axis=-1)
            name = key.removeprefix("frame.")
            if name in tips:
                twist = twist + self.error(f"{name[0]}_leg.length")[:, None] * [1.0, 0.0, 0.0]
            if not (twist.any() or turn.any()):
                moved = np.broadcast_to(np.eye(4), (self.count, 4, 4))
            else:
                moved = expm(twist_matrix(np.concatenate([twist, turn], axis=-1)))
            rotation = j.rotation @ moved[:, :3, :3]
            position = j.position + moved[:, :3, 3] @ j.rotation.T
            self.placed[j.name] = rotation[:, None], position[:, None]
            if name in tips:
                along = j.rotation.T @ j.position / np.linalg.norm(j.position)
                axis = np.concatenate([np.broadcast_to(along, turn.shape), turn], axis=-1)
                by_growth = expm(twist_matrix(axis))[:, :3, 3] @ j.rotation.T
                self.grown[j.name] = by_growth[:, None]

    # ---- kinematics

    def actual_drives(self, states):
        """Actual drive coordinates, shape (M, K, 3), [m]."""
        result = np.empty((self.count, *states.drives.shape))
        for i, d in enumerate(self.drives):
            u = states.drives[None, :, i]
            sine, cosine = (self.error(f"{d}.screw_{k}")[:, None] for k in ("sin", "cos"))
            turned = 2.0 * np.pi * np.mod(u, self.lead) / self.lead
            screw = u + sine * np.sin(turned) + cosine * np.cos(turned)
            warmer = screw * (1.0 + self._growth("screws", states.temperature))
            slack = np.where(states.approach[:, i] > 0, -0.5, 0.5) * (states.approach[:, i] != 0)
            there = warmer + self.error(f"{d}.backlash")[:, None] * slack
            gain = 1.0 + self.error(f"{d}.scale")[:, None]
            result[:, :, i] = gain * there + self.error(f"{d}.offset")[:, None]
        return result

    def _growth(self, part, temperature):
        """Relative expansion, shape (M, K)."""
        if self.expansion is None:
            return np.zeros((self.count, temperature.size))
        coefficient = getattr(self.expansion, part) + self.error(f"{part}.expansion")
        return coefficient[:, None] * (temperature - self.expansion.reference)

    def rod_growth(self, states):
        """Growth of each rod, shape (M, K, 6), [m]."""
        warm = self._growth("legs", states.temperature) * self.length
        return np.repeat(warm[..., None], 6, axis=-1) + states.stretch

    def frames(self, actual, passive, growth):
        """Rotations (M, K, 3, 3) and positions (M, K, 3) of all links.

        Actual drives (M, K, 3), passive coordinates (M, K, 18), growth of rods (M, K, 6), [m, rad].
        """
        poses = {"base": (np.eye(3)[None, None], np.zeros((1, 1, 3)))}
        for j in self.joints:
            rotation, position = self.placed[j.name]
            if j.name in self.grown:
                rod = 2 * "xyz".index(j.name[0]) + (j.kind == "fixed")
                position = position + growth[..., rod, None] * self.grown[j.name]
            above, origin = poses[j.parent]
            position = origin + (above @ position[..., None])[..., 0]
            rotation = above @ rotation
            if j.kind == "prismatic":
                value = actual[..., self.drives.index(j.name)]
                position = position + (rotation @ j.axis) * value[..., None]
            elif j.kind == "revolute":
                rotation = rotation @ _turn(j.axis, passive[..., self.passive.index(j.name)])
            poses[j.child] = rotation, position
        return poses

    def opening(self, actual, passive, growth):
        """How far the loops are open, shape (M, K, 18), [m, rad]."""
        poses, rows = self.frames(actual, passive, growth), []
        for (a, b), kind in self.pairs:
            (ra, pa), (rb, pb) = poses[a], poses[b]
            apart = (np.swapaxes(ra, -1, -2) @ (pb - pa)[..., None])[..., 0]
            if kind == "3d":
                rows.append(apart[..., [0, 2]])
                continue
            turned = np.swapaxes(ra, -1, -2) @ rb
            skew = turned - np.swapaxes(turned, -1, -2)
            about = 0.5 * np.stack([skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]], axis=-1)
            rows += [apart, about]
        return np.concatenate(rows, axis=-1)

    def close(self, actual, growth):
        """Passive coordinates with closed loops, shape (M, K, 18), [rad]."""
        q, inverse, size = self._begin(actual), None, np.inf
        for _ in range(60):
            opening = self.opening(actual, q, growth)
            before, size = size, np.abs(opening).max()
            if size < CLOSED or (size < ROUNDING and size > 0.5 * before):
                return q
            if inverse is None or size > 0.1 * before:
                # that of the nominal machines for a batch, until it converges slowly
                shared = inverse is None and self.count > 1
                machine = IndependentMachine(self.folder, {}) if shared else self
                at = (a.mean(axis=0, keepdims=True) if shared else a for a in (actual, q, growth))
                inverse = np.linalg.inv(machine._slopes(*at))
            q = q - (inverse @ opening[..., None])[..., 0]
        raise RuntimeError(f"loops stay open by {size:.2g}")

    def _begin(self, actual):
        """Passive coordinates to start from: the nominal machine's for a batch."""
        shape = (self.count, actual.shape[1], len(self.passive))
        if self.count == 1:
            return np.zeros(shape)
        nominal, mean = IndependentMachine(self.folder, {}), actual.mean(axis=0, keepdims=True)
        return np.broadcast_to(nominal.close(mean, np.zeros((1, shape[1], 6))), shape)

    def _slopes(self, actual, q, growth):
        """Derivative of the opening by finite differences, shape (M, K, 18, 18)."""
        columns = []
        for i in range(q.shape[-1]):
            step = STEP * (np.arange(q.shape[-1]) == i)
            ends = [self.opening(actual, q + s * step, growth) for s in (1.0, -1.0)]
            columns.append((ends[0] - ends[1]) / (2.0 * STEP))
        return np.stack(columns, axis=-1)

    def tool(self, states):
        """Positions of the tool centre point, shape (M, K, 3), [m]."""
        actual, growth = self.actual_drives(states), self.rod_growth(states)
        return self.frames(actual, self.close(actual, growth), growth)["tcp"][1]

    # ---- readings

    def read(self, states, gauges, gauge, state, nuisance=None, time=None, drift=None):
        """Readings with gauge zeros at 0, shape (M, n), [m], of a gauge, a state and a time, [s].

        `nuisance` maps roll, pitch, section and scale to (M, n_gauges); so has `drift`, [m/s].
        """
        actual, growth = self.actual_drives(states), self.rod_growth(states)
        poses = self.frames(actual, self.close(actual, growth), growth)
        result = np.empty((self.count, len(gauge)))
        for i, g in enumerate(gauges):
            rows = np.flatnonzero(gauge == i)
            errors = {k: v[:, i] for k, v in (nuisance or {}).items()}
            tip, direction, edge = self._mount(g, errors)
            ends = [poses[f][1][:, state[rows]] for f in self._line(g)]
            shown = _touch(g, *ends, tip, direction, edge)
            shown = shown * (1.0 + errors.get("scale", np.zeros(self.count)))[:, None]
            if drift is not None:
                shown = shown + drift[:, i, None] * time[rows]
            result[:, rows] = shown
        return result

    def _line(self, gauge):
        """Links at the ends of the line or rod that a gauge touches."""
        k = gauge.leg
        if gauge.rod is None:
            return f"{k}_leg_root", f"{k}_leg_tip"
        return {"a": (f"{k}_rod_a", f"{k}_crossbar"), "b": (f"{k}_rod_b", f"{k}_rod_b_tip")}[
            gauge.rod
        ]

    def _mount(self, gauge, errors):
        """Tip at reading 0, direction and edge of a gauge, shape (M, 3) each.

        The stand is on the base, at the section as the operator measured it from the slide at the
        mechanical zero. It stays there when the machine gets warmer.
        """
        k, zero = gauge.leg, np.full((1, 3), self.length) - self.active
        still = States(zero, np.zeros((1, 3)), np.full(1, self._reference))
        straight = np.zeros((self.count, 1, len(self.passive)))
        poses = self.frames(self.actual_drives(still), straight, np.zeros((1, 1, 6)))
        root = poses[f"{k}_leg_root"][1][:, 0]
        axis = -np.eye(3)["xyz".index(k)]
        across = np.zeros(3)
        if gauge.rod is not None:
            nominal = self._nominal_root(gauge)
            across = nominal - (nominal @ axis) * axis
        plane = root @ axis + gauge.fraction * self.length
        side = np.cross(axis, gauge.direction)
        none = np.zeros(self.count)
        roll, pitch, section = (errors.get(n, none) for n in ("roll", "pitch", "section"))
        tip = (plane + section)[:, None] * axis + across
        about_leg = Rotation.from_rotvec(roll[:, None] * axis)
        direction = about_leg.apply(
            Rotation.from_rotvec(-pitch[:, None] * side).apply(gauge.direction)
        )
        return tip, direction, about_leg.apply(side)

    @property
    def _reference(self):
        return 20.0 if self.expansion is None else self.expansion.reference

    def _nominal_root(self, gauge):
        """Root of a rod of the nominal machine at the mechanical zero, shape (3,), [m]."""
        pose = np.eye(4)
        chain, link = [], f"{gauge.leg}_rod_{gauge.rod}"
        while link != "base":
            joint = next(j for j in self.joints if j.child == link)
            chain.append(joint)
            link = joint.parent
        for j in reversed(chain):
            step = np.eye(4)
            step[:3, :3], step[:3, 3] = j.rotation, j.position
            if j.kind == "prismatic":
                step[:3, 3] += j.rotation @ j.axis * self.length
            pose = pose @ step
        return pose[:3, 3]


def _read_joint(element):
    origin = element.find("origin")
    xyz = np.array([float(v) for v in origin.get("xyz").split()])
    rpy = [float(v) for v in origin.get("rpy").split()]
    axis = element.find("axis")
    return Joint(
        element.get("name"),
        element.get("type"),
        element.find("parent").get("link"),
        element.find("child").get("link"),
        Rotation.from_euler("xyz", rpy).as_matrix(),
        xyz,
        None if axis is None else np.array([float(v) for v in axis.get("xyz").split()]),
    )


def _turn(axis, angle):
    """Rotations about a coordinate axis, shape (..., 3, 3)."""
    i = int(np.abs(axis).argmax())
    sine, cosine = np.sin(angle) * axis[i], np.cos(angle)
    result = np.zeros((*angle.shape, 3, 3))
    j, k = (i + 1) % 3, (i + 2) % 3
    result[..., i, i] = 1.0
    result[..., j, j] = result[..., k, k] = cosine
    result[..., j, k], result[..., k, j] = -sine, sine
    return result


def _touch(gauge, root, end, tip, direction, edge):
    """Travel of the plunger until it touches, shape (M, n), [m]."""
    along = end - root
    tip, direction, edge = (v[:, None] for v in (tip, direction, edge))
    if gauge.rod is None:
        # tip + h d + m e = root + s (end - root)
        columns = [np.broadcast_to(v, along.shape) for v in (direction, edge, -along)]
        return np.linalg.solve(np.stack(columns, axis=-1), (root - tip)[..., None])[..., 0, 0]
    unit = along / np.linalg.norm(along, axis=-1, keepdims=True)

    def excess(h):
        """Square of the ball's distance from the rod's axis at a travel, less that of contact."""
        across = np.cross(tip + h * direction - root, unit)
        return (across**2).sum(axis=-1) - gauge.radius**2

    # a quadratic polynomial, from three of its values
    h = 0.02
    low, middle, high = excess(-h), excess(0.0), excess(h)
    a, b = (high + low - 2.0 * middle) / (2.0 * h**2), (high - low) / (2.0 * h)
    return (-b + np.sqrt(b**2 - 4.0 * a * middle)) / (2.0 * a)
