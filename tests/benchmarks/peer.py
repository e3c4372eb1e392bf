"""The same estimate without orthocal's program: `scipy.optimize.least_squares` on Pinocchio.

This is what one would write instead: residuals of the error parameters alone, the loops of every
posture closed inside, derivatives by finite differences. It is given every advantage that needs no
symbolic derivatives: loops start from where they were last closed, Pinocchio's buffers are kept,
gauge zeros are eliminated by their means, variables are scaled by their tolerances, and only what
a reading needs is evaluated. Nothing here evaluates CasADi, so it is a second way to the optimum.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import least_squares

from orthocal.robot.closing import CLOSURE_TOLERANCE
from orthocal.robot.model import Robot
from orthocal.sensors.leg_indicator import DIRECTIONS
from orthocal.session.session import Session

Array = NDArray[np.float64]

STOP = 1e-8
"""[1] SciPy's own `ftol` and `xtol`: the last step changes objective and errors by less."""

REFINED_STOP = 1e-14
"""[1] The same for `PeerProblem.refine`."""

CENTRAL_STEP = 1e-6
"""Step of central differences, [m, rad]."""

MAX_NEWTON_STEPS = 60


@dataclass(frozen=True, slots=True, eq=False)
class PeerSolution:
    """What the peer found."""

    errors: Array
    """Error parameters, shape (n_free,), [m, rad]."""
    objective: float
    """½ Σ ((y − h − z)/σ)² + ½ Σ (θ/prior std)², as orthocal's."""
    seconds: float
    evaluations: int
    """How often all loops were closed."""


class LoopCloser:
    """Closes the loops of a machine by Newton's method on Pinocchio's constraint models.

    The same as `Robot.close_with_pinocchio`, several times faster: buffers are kept, and the
    constraint Jacobians are used as they come. They are exact where the loops are closed, so
    convergence stays quadratic.

    Args:
        machine: With its errors in its placements, and without unbounded revolute joints.
    """

    def __init__(self, machine: Robot) -> None:
        self.machine = machine
        self.data = machine.model.createData()
        self._constraints = [
            (constraint, constraint.createData(), list(closure.rows))
            for closure, constraint in zip(machine.closures, machine.constraints, strict=True)
        ]

    def close(self, drives: Array, start: Array) -> Array:
        """Passive coordinates that close the loops; `data` then holds this posture.

        Args:
            drives: Commanded drive coordinates, shape (n_drives,), [m].
            start: Passive coordinates to start from, shape (n_passive,), [m, rad].

        Returns:
            Shape (n_passive,), [m, rad].

        Raises:
            RuntimeError: If Newton's method does not converge.
        """
        model, data, index = self.machine.model, self.data, self.machine.passive_index
        coordinates = self.machine.joint_coordinates(drives, start)
        for _ in range(MAX_NEWTON_STEPS):
            pin.computeJointJacobians(model, data, coordinates)
            residuals = []
            for constraint, buffer, rows in self._constraints:
                constraint.calc(model, data, buffer)
                residuals.append(buffer.constraint_position_error[rows])
            residual = np.concatenate(residuals)
            if np.abs(residual).max() < CLOSURE_TOLERANCE:
                return coordinates[index]
            jacobian = np.concatenate(
                [c.jacobian(model, data, buffer)[rows] for c, buffer, rows in self._constraints]
            )
            coordinates[index] -= np.linalg.solve(jacobian[:, index], residual)
        raise RuntimeError(f"loops stay open by {np.abs(residual).max():.3g} m")


class PeerProblem:
    """Residuals of a session's readings and of the prior, as functions of the errors alone.

    Args:
        session: Readings as shown, not differences.
        names: Free error parameters.
        sigma: Standard deviation of one reading, [m].
    """

    def __init__(self, session: Session, *, names: Sequence[str], sigma: float) -> None:
        robot = session.robot
        self.robot = robot
        self.names = tuple(names)
        self.sigma = sigma
        self.prior_stds = np.array([robot.parameters[n].prior_std for n in names])
        self.evaluations = 0
        self._readings = session.values
        self._zero_drives = session.zero_drives[0]  # one session

        postures = {name: k for k, name in enumerate(session.postures)}
        setups = {name: k for k, name in enumerate(session.setups)}
        legs = {name: k for k, name in enumerate(robot.legs)}
        self._posture = np.array([postures[r.posture] for r in session.readings])
        self._setup = np.array([setups[r.setup] for r in session.readings])
        sensors = [s.sensor for s in session.setups.values()]
        self._leg = np.array([legs[s.leg] for s in sensors])[self._setup]
        self._direction = np.array([DIRECTIONS[s.direction] for s in sensors])
        planes = [s.plane(robot) for s in sensors]
        self._plane = np.array([plane for plane, _ in planes])
        self._from_root = np.array([from_root for _, from_root in planes])
        self._axis = np.array([leg.axis for leg in robot.legs.values()])
        self._ends = [
            (robot.frame_id(leg.root), robot.frame_id(leg.tip)) for leg in robot.legs.values()
        ]
        self._drives = np.array([p.drives for p in session.postures.values()])
        self._legs_read = [np.unique(self._leg[self._posture == k]) for k in postures.values()]
        self._passive = np.tile(robot.reference_passive, (len(postures), 1))

    def predict(self, errors: ArrayLike) -> Array:
        """Readings with gauge zeros at 0, shape (n_readings,), [m].

        Args:
            errors: Shape (n_free,), [m, rad].
        """
        machine = self.robot.with_errors(dict(zip(self.names, np.asarray(errors), strict=True)))
        closer = LoopCloser(machine)
        ends = np.zeros((len(self._drives), len(self._ends), 2, 3))
        for k, (drives, legs) in enumerate(zip(self._drives, self._legs_read, strict=True)):
            self._passive[k] = closer.close(drives, self._passive[k])
            for leg in legs:
                for end, frame in enumerate(self._ends[leg]):
                    place = pin.updateFramePlacement(machine.model, closer.data, frame)
                    ends[k, leg, end] = place.translation
        root, tip = ends[self._posture, self._leg].transpose(1, 0, 2)
        axis = self._axis[self._leg]
        plane = (self._plane + self._section_starts(machine, closer.data))[self._setup]
        along = (plane - _dots(axis, root)) / _dots(axis, tip - root)
        return _dots(self._direction[self._setup], root + along[:, None] * (tip - root))

    def residuals(self, errors: Array) -> Array:
        """What the sum of squares is made of: readings over σ, then errors over tolerances.

        The best zero of a setup is the mean of what its readings leave, whatever the errors.

        Args:
            errors: Shape (n_free,), [m, rad].

        Returns:
            Shape (n_readings + n_free,), [1].
        """
        self.evaluations += 1
        left = self._readings - self.predict(errors)
        means = np.bincount(self._setup, left) / np.bincount(self._setup)
        return np.concatenate([(left - means[self._setup]) / self.sigma, errors / self.prior_stds])

    def solve(self) -> PeerSolution:
        """Estimate the errors, from 0.

        Levenberg-Marquardt needs the fewest evaluations of SciPy's methods here. The variables stay
        in SI units: the difference step of 1.5e-8 m and rad is far above CLOSURE_TOLERANCE,
        whereas a step of 1.5e-8 tolerances would be lost in it.
        """
        began = time.process_time()
        found = least_squares(
            self.residuals,
            np.zeros(len(self.names)),
            method="lm",
            x_scale=self.prior_stds,
            ftol=STOP,
            xtol=STOP,
        )
        seconds = time.process_time() - began
        if not found.success:
            raise RuntimeError(found.message)
        return PeerSolution(found.x, float(found.cost), seconds, self.evaluations)

    def refine(self, errors: Array) -> PeerSolution:
        """Continue from a solution with central differences, whose optimum is nearer.

        With forward differences weakly determined errors stop up to 0.007 tolerances beside it.
        Up to there the Jacobian does not change.

        Args:
            errors: The solution, shape (n_free,), [m, rad].
        """
        began = time.process_time()
        jacobian = self._central_jacobian(errors)
        found = least_squares(
            self.residuals,
            errors,
            jac=lambda _: jacobian,
            method="lm",
            x_scale=self.prior_stds,
            ftol=REFINED_STOP,
            xtol=REFINED_STOP,
        )
        seconds = time.process_time() - began
        return PeerSolution(found.x, float(found.cost), seconds, self.evaluations)

    def _central_jacobian(self, errors: Array) -> Array:
        """Derivatives of the residuals, shape (n_readings + n_free, n_free)."""
        steps = CENTRAL_STEP * np.eye(errors.size)
        columns = [self.residuals(errors + e) - self.residuals(errors - e) for e in steps]
        return np.array(columns).T / (2.0 * CENTRAL_STEP)

    def _section_starts(self, machine: Robot, data: pin.Data) -> Array:
        """Where the sections of each setup count from: 0, or the root in the zero posture, [m].

        The root needs its drive alone, so no loops are closed.
        """
        passive = self.robot.reference_passive
        pin.forwardKinematics(
            machine.model, data, machine.joint_coordinates(self._zero_drives, passive)
        )
        roots = [
            axis @ pin.updateFramePlacement(machine.model, data, root).translation
            for axis, (root, _) in zip(self._axis, self._ends, strict=True)
        ]
        legs = np.zeros(len(self._plane), dtype=np.int64)
        legs[self._setup] = self._leg
        return np.where(self._from_root, np.array(roots)[legs], 0.0)


def _dots(a: Array, b: Array) -> Array:
    """Scalar products of rows, shape (n,) of (n, 3)."""
    return np.einsum("ni,ni->n", a, b)
