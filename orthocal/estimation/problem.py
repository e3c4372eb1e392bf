"""Calibration problem: free parameters with their priors, readings, and their predictions.

    min over θ, z, q_1..q_K   Σ ρ((y − h(q_k, θ) − z)/σ) + ½ Σ ((θ − mean)/prior std)²
    s.t.                      g(q_k, θ) = 0 for every state k,  lower ≤ θ ≤ upper

ρ is the loss and h the predicted reading. A state k is a posture under one set of conditions, with
the passive coordinates q_k and the loop closures g = 0. θ consists of errors of the machine and
nuisance parameters of the sensors. Known gauge zeros z are 0.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from orthocal.arguments import require_kind
from orthocal.arrays import Array, Mask
from orthocal.errors import ClosureError, ParameterError
from orthocal.estimation.mirrored_starts import (
    MirroredDirections,
    find_mirrored_directions,
    mirrored_starts,
)
from orthocal.estimation.selection import KnownWithStd, Selection, select_parameters
from orthocal.estimation.tolerance_scale import AS_STATED, ToleranceScale
from orthocal.io.fields import read_only
from orthocal.kinematics.continuation import Failures
from orthocal.kinematics.loop_closure import LoopClosure
from orthocal.kinematics.robot_functions import RobotFunctions
from orthocal.observation.model import ObservationModel, ReadingLinearisation
from orthocal.observation.observations import Observations, build_observations
from orthocal.observation.sensor_groups import nuisance_parameters
from orthocal.observation.twist_derivatives import FreeParameters
from orthocal.robot.model import coordinate_units
from orthocal.robot.redundant import require_independent_rows
from orthocal.session.session import Session

LENGTH_SCALE = 1e-3
"""Scale of closures, passive motions and gauge zeros, [m]."""


class CalibrationProblem:
    """Readings of a session and the parameters to estimate from them.

    The free parameters are errors of the machine, then nuisance parameters of the sensors, as
    deviations from the manual alignment. An entry is a single reading; a difference has two.
    Readings are divided by the ratio of their gauge's noise to that of the first gauge, so that all
    have equal standard deviations. Their unit is written "noise-scaled m". It is the metre for the
    first gauge, so for all readings of a session with one gauge.

    Args:
        session: The session, or several joined ones.
        selection: The free errors of the machine and their priors.
        noise_ratio: Noise of each entry's gauge divided by that of the first gauge,
            shape (n_entries,); 1 by default.

    Attributes:
        session: The session.
        robot: Robot of the session.
        machine_selection: The argument `selection`.
        selection: `machine_selection` with the nuisance parameters appended.
        parameters: The free parameters of `selection`.
        states: Loop closures to solve.
        passive_scale: Value of one unit of each scaled passive coordinate, shape (n_passive,),
            [m, rad].
        free: Names of the free parameters, in the order of the Jacobian's columns.
        fixed: Known values of parameters by name, [SI].
        observations: Setup, posture and zero of each entry.
        noise_ratio: The argument `noise_ratio`.
        theta_scale: Prior standard deviations of the free parameters, shape (n_free,), [SI].
        prior_precision: 1 for a free parameter with a prior, otherwise 0, shape (n_free,),
            [1 per prior std²].
        prior_mean: Means of the priors, shape (n_free,), [SI].

    Raises:
        RobotError: If closure rows of the robot are linearly dependent.
    """

    def __init__(
        self, session: Session, selection: Selection, *, noise_ratio: Array | None = None
    ) -> None:
        require_kind(session, Session, expected="a Session, such as load_session(...)")
        require_kind(selection, Selection, expected="a Selection, such as Choice(...).select(...)")
        self.session = session
        self.robot = session.robot
        self.machine_selection = selection
        selection = selection.with_nuisance(nuisance_parameters(session).parameters)
        self.selection = selection
        self.free = selection.names
        self.parameters = selection.parameters
        self.fixed = dict(selection.fixed)
        require_independent_rows(self.robot)
        self.observations: Observations = build_observations(session)
        self.noise_ratio = np.ones(self.observations.size) if noise_ratio is None else noise_ratio
        self.states = self.observations.states
        self.theta_scale = read_only(selection.prior_stds)
        self.prior_precision = read_only(selection.prior)
        self.prior_mean = read_only(np.where(selection.prior, selection.mean, 0.0))
        self.passive_scale = LENGTH_SCALE / coordinate_units(self.robot)[self.robot.passive_index]

    def with_values(self, values: ArrayLike) -> CalibrationProblem:
        """Problem with other readings of the same rows; it shares all functions.

        Args:
            values: Readings of the session's rows, shape (n_rows,), [m].
        """
        _ = self.closure, self.model, self._free_parameters  # built once, not in every copy
        other = copy.copy(self)
        other.session = self.session.with_values(np.asarray(values, dtype=np.float64))
        other.__dict__.pop("values", None)
        return other

    def with_noise_ratio(self, noise_ratio: Array) -> CalibrationProblem:
        """Problem with other noise ratios; it shares all functions.

        Args:
            noise_ratio: Noise of each entry's gauge divided by that of the first gauge, shape
                (n_entries,).
        """
        other = copy.copy(self)
        other.noise_ratio = noise_ratio
        for cached in ("values", "linearisation_at_active", "mirrored"):
            other.__dict__.pop(cached, None)
        return other

    @property
    def n_machine(self) -> int:
        """Number of free errors of the machine, which come first among the free parameters."""
        return len(self.machine_selection.parameters)

    @property
    def n_free(self) -> int:
        """Number of free parameters including nuisance parameters."""
        return len(self.free)

    @property
    def has_prior(self) -> bool:
        """True if any parameter has a prior."""
        return bool(self.prior_precision.any())

    @property
    def n_states(self) -> int:
        """Number of states: postures under different conditions."""
        return self.states.posture.size

    @cached_property
    def active_theta(self) -> Array:
        """Free parameters at the active offsets of the controller, shape (n_free,), [SI].

        All other parameters are 0. The values are clipped to the bounds. They are the point of
        linearisation and the default start values.
        """
        return read_only(self._theta_at(self.session.active_offsets))

    def _theta_at(self, offsets: Array) -> Array:
        """Free parameters of the nominal machine with offsets, within their bounds, (n_free,)."""
        names = (f"{d.name}.offset" for d in self.robot.drives)
        by_name = dict(zip(names, offsets, strict=True))
        theta = np.array([by_name.get(name, 0.0) for name in self.free])
        return np.asarray(np.clip(theta, self.selection.lower, self.selection.upper))

    def predict_nominal(self, deviations: Array) -> Array:
        """Readings of the nominal machine, each with the active offsets of its setup.

        A mounting that was estimated from wrong readings may miss the rod of the nominal machine.
        The gauge of such a setup is then assumed to be exactly aligned.

        Args:
            deviations: Nuisance parameters as deviations from the manual alignment, shape
                (n_nuisance,), [SI].

        Returns:
            Shape (n_entries,), [noise-scaled m]; NaN where offsets of a single setup make the
            posture unreachable.

        Raises:
            ClosureError: If a posture cannot be reached with the active offsets of the session.
        """
        n, setup = self.n_machine, self.observations.setup
        # a setup may state active offsets of its own
        active = (self.robot.drive_zero - self.session.zero_drives)[setup]
        result = np.empty(self.observations.size)
        for offsets in np.unique(active, axis=0):
            theta = self._theta_at(offsets)
            is_active = np.array_equal(theta, self.active_theta)
            passive = self.active_passive if is_active else self.close(theta, failures={})
            rows = (active == offsets).all(axis=1)
            result[rows] = self.predict(np.append(theta[:n], deviations), passive)[rows]
            missed = rows & np.isin(setup, setup[rows & np.isnan(result)])
            if missed.any():
                aligned = np.append(theta[:n], np.zeros_like(deviations))
                result[missed] = self.predict(aligned, passive)[missed]
        return result

    @cached_property
    def values(self) -> Array:
        """Readings of the entries, shape (n_entries,), [noise-scaled m]."""
        return self.observations.values(self.session.values) / self.noise_ratio

    @cached_property
    def zero_incidence(self) -> Array:
        """Incidence matrix of entries and gauge zeros, shape (n_entries, n_zeros)."""
        result = np.zeros((self.observations.size, self.observations.n_zeros))
        result[np.arange(self.observations.size), self.observations.zero] = 1.0
        return read_only(result)

    @cached_property
    def closure(self) -> LoopClosure:
        """Loop closure solver for values of the machine's free parameters."""
        return LoopClosure(self.robot, free=self.machine_selection.names, fixed=self.fixed)

    def close(
        self,
        theta: ArrayLike,
        *,
        start: Array | None = None,
        failures: Failures | None = None,
    ) -> Array:
        """Passive coordinates of every state with closed loops.

        Args:
            theta: Free parameters, shape (n_free,) or (n_machine,), or with S in front for a batch,
                [SI].
            start: Start values of the passive coordinates; those at the active offsets by default.
            failures: Filled with the flat indices s · n_states + k of states that cannot be
                reached, whose results are NaN (see `LoopClosure.close`); by default the first of
                them raises.

        Returns:
            Shape (n_states, n_passive), or (S, n_states, n_passive) for a batch, [m, rad].

        Raises:
            ClosureError: If a machine with these errors cannot reach a posture.
        """
        return self.closure.close(
            self.states.commands,
            theta=self._of_machine(theta),
            start=self._active_passive_or_none if start is None else start,
            names=self.states.names,
            failures=failures,
        )

    def simulate(self, theta: Array) -> tuple[Array, Array, Mask]:
        """Simulate the exact readings of a batch of machines.

        Args:
            theta: Free parameters, shape (S, n_free), [SI].

        Returns:
            Readings, shape (S, n_entries), [noise-scaled m]; passive coordinates, shape
            (S, n_states, n_passive); and a mask of the machines that reach every posture, shape
            (S,). Results of the other machines contain NaN.
        """
        failures: Failures = {}
        passive = self.close(theta, start=self._first_order_passive(theta), failures=failures)
        reached = np.ones(len(theta), dtype=np.bool_)
        reached[[i // max(self.n_states, 1) for i in failures]] = False
        return self.predict(theta, passive), passive, reached

    def _first_order_passive(self, theta: Array) -> Array | None:
        """Linearised passive coordinates of a batch, as start values; None if that fails."""
        if self._active_passive_or_none is None:
            return None
        try:
            linear = self.linearisation_at_active
        except np.linalg.LinAlgError:
            return None
        change = (theta - self.active_theta) / self.theta_scale
        return np.asarray(self._active_passive_or_none + linear.follow(change))

    @cached_property
    def linearisation_at_active(self) -> ReadingLinearisation:
        """Readings linearised about the active offsets."""
        return self.linearise(self.active_theta, self.active_passive)

    @cached_property
    def _active_passive_or_none(self) -> Array | None:
        """`active_passive`; None if a posture cannot be reached with the active offsets."""
        try:
            return self.active_passive
        except ClosureError:
            return None

    @cached_property
    def active_passive(self) -> Array:
        """Passive coordinates at the active offsets, shape (n_states, n_passive), [m, rad].

        Raises:
            ClosureError: If a posture cannot be reached with the active offsets.
        """
        theta = self._of_machine(self.active_theta)
        return self.closure.close(self.states.commands, theta=theta, names=self.states.names)

    def nuisance_values(self, theta: ArrayLike) -> Array:
        """Nuisance parameters: manual alignment plus deviations, shape (..., n_nuisance), [SI].

        Args:
            theta: Free parameters, shape (..., n_free), [SI]; or (..., n_machine) for deviations of
                0.
        """
        deviations = np.asarray(theta, dtype=np.float64)[..., self.n_machine :]
        aligned = self.model.alignment(self.elementary_errors(theta))
        return aligned + deviations if deviations.size else aligned

    def elementary_errors(self, theta: ArrayLike) -> Array:
        """Elementary errors, shape (..., n_errors), of free parameters, (..., n_free), [SI]."""
        return self.closure.errors(self._of_machine(theta))

    def predict(self, theta: ArrayLike, passive: Array | None = None) -> Array:
        """Predicted readings h(q(θ), θ) of all entries, gauge zeros at 0.

        Args:
            theta: Free parameters, shape (n_free,) or (S, n_free), [SI]. With n_machine values the
                nuisance parameters are those of the manual alignment.
            passive: Passive coordinates with closed loops at theta, shape (n_states, n_passive) or
                (S, n_states, n_passive), [m, rad]; solved by default.

        Returns:
            Shape (n_entries,) or (S, n_entries), [noise-scaled m].

        Raises:
            ClosureError: If a machine with these errors cannot reach a posture.
        """
        q = self.close(theta) if passive is None else passive
        readings = self.model.predict(
            self.elementary_errors(theta), q, self._nuisance_deviations(theta)
        )
        return np.asarray(readings / self.noise_ratio)

    @cached_property
    def mirrored(self) -> MirroredDirections:
        """Directions of nuisance parameters that may have local optima on both sides."""
        vectors = [self.n_machine + np.array(v) for v in self.model.nuisance.mirrored]
        if not vectors:
            return MirroredDirections(np.zeros((0, self.n_free)), np.zeros(0))
        start = (self.active_theta / self.theta_scale)[None]
        predict = self._predict_near(start, self.active_passive[None])
        return find_mirrored_directions(predict, vectors, self.n_free)

    def mirrored_starts(self, theta: Array, passive: Array, directions: Array) -> Array:
        """Start values of other local optima, shape (n_starts, S, n_free), [SI].

        Args:
            theta: Solutions of S sets of readings, shape (S, n_free), [SI].
            passive: Their passive coordinates, shape (S, n_states, n_passive), [m, rad].
            directions: Mirrored directions along which a start may change, shape (n, n_free).
        """
        scaled = theta / self.theta_scale
        predict = self._predict_near(scaled, passive)
        return mirrored_starts(predict, scaled, directions) * self.theta_scale

    def _predict_near(self, theta: Array, passive: Array) -> Callable[[Array], Array]:
        """Function from changes of the nuisance parameters in θ̂ to readings (see `Predict`)."""

        def predict(changes: Array) -> Array:
            n_sets, n = len(theta), len(changes)
            changed = (theta[:, None] + changes).reshape(n_sets * n, -1) * self.theta_scale
            return self.predict(changed, passive.repeat(n, axis=0)).reshape(n_sets, n, -1)

        return predict

    def predict_and_jacobian(
        self,
        theta: ArrayLike,
        passive: Array | None = None,
        *,
        units: Literal["prior_std", "SI"] = "prior_std",
    ) -> tuple[Array, Array]:
        """Predicted readings and identification Jacobian with closed loops.

        ∂q/∂θ = −g_q⁻¹ g_θ by the implicit function theorem, and J = h_θ − h_q g_q⁻¹ g_θ.

        Args:
            theta: Free parameters, shape (n_free,) or (S, n_free), [SI].
            passive: Passive coordinates with closed loops at theta; solved by default.
            units: Unit of the columns. "prior_std": dh/dθ̂ in metres per prior standard deviation
                of the parameter, for the solvers. "SI": dh/dθ in metres per SI unit.

        Returns:
            Readings, shape (n_entries,), [noise-scaled m], and Jacobian, shape (n_entries,
            n_free); both with S in front for a batch.

        Raises:
            ClosureError: If a machine with these errors cannot reach a posture.
            LinAlgError: If passive coordinates are passed and a posture is singular.
            ParameterError: If the units are unknown, or theta has another size.
        """
        size = np.atleast_1d(theta).shape[-1]
        if size not in (self.n_free, self.n_machine):
            raise ParameterError(f"has {size} numbers; expected {self.n_free}", where="theta")
        if units not in ("prior_std", "SI"):
            raise ParameterError(f"found {units!r}; expected 'prior_std' or 'SI'", where="units")
        q = self.close(theta) if passive is None else passive
        linear = self.linearise(theta, q)
        jacobian = linear.jacobian
        return linear.reading, jacobian if units == "prior_std" else jacobian / self.theta_scale

    def linearise(
        self, theta: ArrayLike, passive: Array, *, free: FreeParameters | None = None
    ) -> ReadingLinearisation:
        """Linearise readings about parameters and passive coordinates near closed loops.

        Args:
            theta: Free parameters, shape (n_free,) or (S, n_free), [SI].
            passive: Passive coordinates, shape (n_states, n_passive) or (S, n_states, n_passive),
                [m, rad].
            free: Parameters of the derivatives; the free parameters by default.

        Raises:
            LinAlgError: If a posture is singular.
        """
        return self.model.linearise(
            self.elementary_errors(theta),
            passive,
            self._nuisance_deviations(theta),
            free=free or self._free_parameters,
            noise_ratio=self.noise_ratio,
        )

    def _of_machine(self, theta: ArrayLike) -> Array:
        """Errors of the machine among the free parameters, shape (..., n_machine), [SI].

        Raises:
            ValueError: If there are neither n_free nor n_machine values.
        """
        values = np.asarray(theta, dtype=np.float64)
        if values.shape[-1:] not in ((self.n_free,), (self.n_machine,)):
            raise ValueError(
                f"theta: found the shape {values.shape}; expected {self.n_free} free parameters, "
                f"or the {self.n_machine} of the machine"
            )
        return values[..., : self.n_machine]

    def _nuisance_deviations(self, theta: ArrayLike) -> Array | None:
        """Deviations of nuisance parameters among the free parameters; None without any."""
        deviations = np.asarray(theta, dtype=np.float64)[..., self.n_machine :]
        return deviations if deviations.size else None

    @cached_property
    def model(self) -> ObservationModel:
        """Observation model of the session."""
        return ObservationModel(self.session, self.observations)

    @property
    def functions(self) -> RobotFunctions:
        """Compiled kinematics and their derivatives."""
        return self.model.functions

    @cached_property
    def _free_parameters(self) -> FreeParameters:
        """Free parameters in the form of the observation model."""
        return self.model.parametrise(self.errors_per_theta, self.theta_scale[self.n_machine :])

    @cached_property
    def errors_per_theta(self) -> Array:
        """Elementary errors per unit of θ̂, shape (n_errors, n_machine), [SI]."""
        selection = self.machine_selection
        return self.functions.errors.unit_errors(selection.names) * selection.prior_stds


def build_problem(
    session: Session,
    *,
    model: str | None = None,
    free: Sequence[str] = (),
    prior: bool | None = None,
    known: Mapping[str, KnownWithStd] | None = None,
    prior_stds: Mapping[str, float] | None = None,
    bounds: Mapping[str, tuple[float, float]] | None = None,
    tolerance_scale: ToleranceScale = AS_STATED,
) -> CalibrationProblem:
    """Build the problem of a session.

    The other arguments and the exceptions are those of `select_parameters`.

    Raises:
        RobotError: If closure rows of the robot are linearly dependent.
    """
    selection = select_parameters(
        session.robot.parameters,
        model=model,
        free=free,
        prior=prior,
        known=known,
        prior_stds=prior_stds,
        bounds=bounds,
        tolerance_scale=tolerance_scale,
    )
    return CalibrationProblem(session, selection)
