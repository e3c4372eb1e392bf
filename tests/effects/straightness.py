"""Guides that are not straight: an effect for tests, and a simulator of such machines.

A guide is bent to a parabola. A slide leaves its line by b u², with u the distance from the middle
of the travel over half of it, and turns with the guide.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np
from independent import IndependentMachine, twist_matrix
from scipy.linalg import expm

from orthocal.effects.protocol import Effect, EffectKeys
from orthocal.io.documents import PositiveNumber
from orthocal.robot.frames import Placement
from orthocal.robot.parameters import ElementaryError
from orthocal.units import MM


class StraightnessKeys(EffectKeys):
    straightness_mm: PositiveNumber = 0.05


@dataclass(frozen=True, eq=False)
class Straightness(Effect):
    name = "straightness"
    keys = StraightnessKeys
    conditions = ("coordinates",)

    robot: object
    errors: tuple[ElementaryError, ...]

    @classmethod
    def from_keys(cls, keys, robot):
        return cls(
            robot,
            tuple(
                ElementaryError(
                    f"{d.name}.bow", "straightness", d.name, "m", keys.straightness_mm * MM
                )
                for d in robot.drives
            ),
        )

    def describe(self):
        return "straightness of the guides"

    def placements(self, errors, conditions):
        twists = {}
        for i, d in enumerate(self.robot.drives):
            bow, half = errors[f"{d.name}.bow"], 0.5 * (d.upper - d.lower)
            u = (conditions["coordinates"][i] - 0.5 * (d.lower + d.upper)) / half
            # along -x of the placement, as the slides of the Orthoglide
            twist = ca.vertcat(0.0, bow * u**2, 0.0, 0.0, 0.0, -2.0 * bow * u / half)
            twists[Placement(int(self.robot.model.getJointId(d.name)), False)] = twist
        return twists


class BentMachine(IndependentMachine):
    """Orthoglides with bent guides, one machine at a time."""

    limits = 0.12, 0.39
    """Travel, [m]."""

    def actual_drives(self, states):
        self.commanded = states.drives
        return super().actual_drives(states)

    def frames(self, actual, passive, growth):
        middle, half = 0.5 * sum(self.limits), 0.5 * (self.limits[1] - self.limits[0])
        for i, d in enumerate(self.drives):
            joint, u = self._joint(d), (self.commanded[:, i] - middle) / half
            twist = np.tile(
                [self.error(f"{d}.{a}")[0] for a in ("x", "y", "z", "rx", "ry", "rz")], (u.size, 1)
            )
            (bow,) = self.error(f"{d}.bow")
            twist[:, 1] += bow * u**2
            twist[:, 5] -= 2.0 * bow * u / half
            moved = expm(twist_matrix(twist))[None]
            self.placed[d] = (
                joint.rotation @ moved[..., :3, :3],
                joint.position + moved[..., :3, 3] @ joint.rotation.T,
            )
        return super().frames(actual, passive, growth)
