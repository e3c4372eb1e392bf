"""Result of a calibration: its record, derived quantities, and the kinematics of its machine.

It contains everything that reports, scenes and exports need. None of them reads the session.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from orthocal.arguments import require_kind
from orthocal.arrays import Array, Mask
from orthocal.calibration.records import CalibrationRecord, ParameterEstimate
from orthocal.effects.compensation import displace_drives
from orthocal.estimation.diagnostics.residual_rows import ResidualRow, root_mean_square
from orthocal.kinematics.conditions import APPROACH, UseConditions
from orthocal.kinematics.loop_closure import LoopClosure, as_rows, require_within_travel
from orthocal.robot.model import Robot
from orthocal.robot.parameters import suggest
from orthocal.sensors.protocol import is_difference
from orthocal.statistics.chance import bounded_interval, expanded_uncertainty
from orthocal.statistics.noise import MIN_DOF


@dataclass(frozen=True, slots=True, eq=False)
class Machine:
    """Kinematics of a robot with error parameters."""

    robot: Robot
    errors: Mapping[str, float]
    """Parameter to value, such as {"x_slide.offset": 1e-3}, [SI]; absent ones are 0."""

    def __post_init__(self) -> None:
        require_kind(self.robot, Robot, expected="a Robot, such as load_robot(...)")
        self.robot.parameters.expand(self.errors)  # refuses unknown names and wrong values
        object.__setattr__(self, "errors", dict(self.errors))

    def forward(
        self,
        joints: ArrayLike,
        *,
        names: Sequence[str] | None = None,
        conditions: UseConditions | None = None,
    ) -> Array:
        """Tool centre point for drive coordinates.

        Args:
            joints: Drive coordinates of the encoders, without offsets of the controller, shape
                (K, n_drives) or (n_drives,), [m, rad].
            names: Names of the rows, for messages.
            conditions: Conditions of use; by default the mean of both sides of approach, the
                reference temperature and no payload.

        Returns:
            Tool positions, shape (K, 3) or (3,), [m].

        Raises:
            ClosureError: If the machine cannot reach such coordinates.
            ParameterError: If a condition is out of range, or nothing depends on it.
        """
        rows, single = as_rows(joints, len(self.robot.drives), "drive coordinates")
        require_within_travel(self.robot, rows, names)
        points = self._closure(conditions).forward(rows, names=names)
        return points[0] if single else points

    def inverse(
        self,
        points: ArrayLike,
        *,
        names: Sequence[str] | None = None,
        conditions: UseConditions | None = None,
    ) -> Array:
        """Drive coordinates for tool positions.

        Args:
            points: Commanded coordinates of the tool, shape (K, n_coordinates) or
                (n_coordinates,), [m]; or positions, shape (K, 3) or (3,).
            names: Names of the rows, for messages.
            conditions: Conditions of use, as for `forward`.

        Returns:
            Drive coordinates of the encoders, shape (K, n_drives) or (n_drives,), [m, rad].

        Raises:
            ClosureError: If a point cannot be reached.
            ParameterError: If a condition is out of range, or nothing depends on it.
        """
        return self._closure(conditions).inverse(points, names=names)

    def _closure(self, conditions: UseConditions | None) -> LoopClosure:
        """Loop closures of the machine under conditions of use."""
        use = UseConditions() if conditions is None else conditions
        require_kind(use, UseConditions, expected="UseConditions, such as UseConditions('ppp')")
        use.require_valid(self.robot)
        return LoopClosure(self.robot, fixed=self.errors, conditions=use)


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Calibration(CalibrationRecord):
    """Calibration: its record, its robot, and quantities derived from both."""

    robot: Robot
    """Nominal robot with the tolerances that the session states."""
    path: Path | None = None
    """File from which it was loaded."""

    def __repr__(self) -> str:
        counts = f"{len(self.residuals)} readings, {len(self.free)} free errors"
        return f"<Calibration of {self.robot.name}: model {self.model!r}, {counts}>"

    def __iter__(self) -> Iterator[ParameterEstimate]:
        return iter(self.parameters)

    def __contains__(self, name: object) -> bool:
        return any(p.name == name for p in self.parameters)

    def __getitem__(self, name: str) -> ParameterEstimate:
        for p in self.parameters:
            if p.name == name:
                return p
        raise KeyError(f"{name}{suggest(name, (p.name for p in self.parameters))}")

    @property
    def free(self) -> tuple[ParameterEstimate, ...]:
        """Free errors of the machine, in the order of the covariance."""
        return tuple(p for p in self.parameters if p.free)

    @property
    def errors(self) -> dict[str, float]:
        """Parameter name to estimate of the nonlinear model, [SI]."""
        return {p.name: p.value for p in self.parameters}

    @property
    def standard_deviations(self) -> Array:
        """Total standard deviations of `free`, shape (n_machine,), [SI].

        They contain noise, priors and unmodelled errors.
        """
        return np.array([p.std for p in self.free])

    @property
    def correlation(self) -> Array:
        """Correlation from noise and priors, shape (n_machine, n_machine); NaN at a bound.

        Parameters that the readings cannot separate have a correlation near ±1.
        """
        std = np.sqrt(np.diag(self.model_covariance))
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(self.model_covariance / np.outer(std, std))

    def correlated(self, *, above: float = 0.5) -> tuple[tuple[str, str, float], ...]:
        """Pairs of free parameters with an absolute correlation above a limit, largest first."""
        names = [p.name for p in self.free]
        matrix = np.nan_to_num(self.correlation)
        pairs = [
            (names[i], names[j], float(matrix[i, j]))
            for i, j in zip(*np.nonzero(np.triu(np.abs(matrix) > above, 1)), strict=True)
        ]
        return tuple(sorted(pairs, key=lambda p: -abs(p[2])))

    @property
    def redundancy(self) -> float:
        """Number of checks of the model: independent readings that determine no parameters.

        A reading may determine a nuisance parameter in part; its prior determines the other part.
        Priors of the machine do not count.
        """
        spectrum = self.identifiability
        return max(spectrum.n_readings - self.structural_rank - spectrum.n_nuisance, 0.0)

    @property
    def structural_rank(self) -> int:
        """Number of combinations of errors that readings without noise would determine."""
        return len(self.free) if self.base else self.identifiability.structural_rank

    @property
    def is_checked(self) -> bool:
        """True if there are enough redundant readings for residuals to check the model."""
        return self.redundancy >= MIN_DOF

    def where(self, row: ResidualRow) -> str:
        """File and line of a row, for messages."""
        file = row.file or self.session.readings_path
        if file is None or row.line is None:
            return f"reading {row.label}"
        return f"{file}:{row.line}"

    @property
    def rms_before(self) -> float:
        """RMS of the deviations, [m]."""
        return root_mean_square(r.deviation for r in self.residuals)

    @property
    def rms_after(self) -> float:
        """RMS of the residuals, [m]."""
        return root_mean_square(r.residual for r in self.residuals)

    @property
    def largest_before(self) -> float:
        """Largest absolute deviation, [m]."""
        return max(abs(r.deviation) for r in self.residuals)

    @property
    def largest_after(self) -> float:
        """Largest absolute residual, [m]."""
        return max(abs(r.residual) for r in self.residuals)

    @property
    def sigma(self) -> float:
        """Standard deviation of one row, [m]: of a difference if all rows are differences."""
        return self.noise.sigma * self.row_factor

    @property
    def dof(self) -> float:
        """Degrees of freedom of sigma."""
        return self.noise.dof

    @property
    def row_factor(self) -> float:
        """Factor from the noise of one reading to `sigma`: √2 if all rows are differences, else 1.

        For the rows of a mixed session see `row_sigma`.
        """
        return math.sqrt(2.0) if self.rows_are_differences else 1.0

    @property
    def total_covariance(self) -> Array:
        """Total covariance of `free`, shape (n_machine, n_machine), [SI].

        From noise and priors (`model_covariance`) and from unmodelled errors with their priors,
        which the tolerance scale multiplies (`unmodelled.bias_covariance`).
        """
        return np.asarray(self.model_covariance + self.unmodelled.bias_covariance)

    @property
    def error_covariances(self) -> tuple[Array, Array, Array]:
        """Covariances of the errors of the estimate, `free` before unmodelled errors, [SI].

        Unmodelled errors θᵤ ~ N(0, V) bias the estimate by L θᵤ (leakage L). With C the covariance
        of `free` without unmodelled errors the total is [[C + L V Lᵀ, −L V], [−V Lᵀ, V]].

        Returns:
            The total, its part from the noise of the readings, and its part from errors that the
            tolerance scale multiplies, shape (n, n) with n = n_machine + n_unmodelled.
        """
        n, unmodelled = len(self.free), self.unmodelled
        leakage = np.vstack([unmodelled.leakage, -np.eye(len(unmodelled.names))])

        def join(covariance: Array, stds: Array) -> Array:
            joint = (leakage * stds**2) @ leakage.T
            joint[:n, :n] += covariance
            return np.asarray(joint)

        stds = unmodelled.prior_stds
        return (
            join(self.model_covariance, stds),
            join(self.noise_covariance, np.zeros_like(stds)),
            join(self.scaled_covariance, stds * self.scaled[n:]),
        )

    @property
    def scaled(self) -> Mask:
        """Mask of the errors whose tolerances the tolerance scale multiplies.

        `free`, then unmodelled errors, shape (n_machine + n_unmodelled,).
        """
        unmodelled = map(self.robot.parameters.are_scaled, self.unmodelled.names)
        return np.array([*(p.scaled for p in self.free), *unmodelled], dtype=np.bool_)

    @property
    def expanded_uncertainties(self) -> Array:
        """Expanded uncertainties of `free`, shape (n_machine,), [SI].

        The coverage factor is k = 2, or Student's 95 % factor if few degrees of freedom determine
        the noise or the tolerance scale; see `statistics.chance.expanded_uncertainty`.
        """
        biases = self.expanded_biases.tolist()
        return np.array(
            [self.expand_estimate(p, bias=b) for p, b in zip(self.free, biases, strict=True)]
        )

    @property
    def expanded_biases(self) -> Array:
        """Parts of `expanded_uncertainties` from unmodelled errors, shape (n_machine,), [SI]."""
        biases = self.unmodelled.leakage * self.unmodelled.prior_stds
        scaled = biases[:, self.scaled[len(self.free) :]]
        return self.expand(*(np.linalg.norm(b, axis=1) for b in (biases, biases[:, :0], scaled)))

    def expand_estimate(self, p: ParameterEstimate, *, bias: float = 0.0) -> float:
        """Expanded uncertainty of an estimate with noise and priors, at most that of its prior.

        Unmodelled errors may bias an estimate by more. For errors of the machine they are added,
        because the estimate is used. A nuisance parameter is stated for information alone, and its
        prior limits the sum.

        Args:
            p: The estimate.
            bias: Part from unmodelled errors that the prior does not limit, [unit].
        """
        expanded = float(self.expand(p.std, p.std_scatter, p.std_scaled))
        if not p.prior:
            return expanded
        of_prior = float(self.expand(p.prior_std, 0.0, p.prior_std * p.scaled))
        return min(expanded, math.hypot(of_prior, bias))

    def expand(self, std: ArrayLike, std_scatter: ArrayLike, std_scaled: ArrayLike) -> Array:
        """Expanded uncertainties of linear functions of `free`, of any shape.

        Args:
            std: Standard deviations.
            std_scatter: Parts of them from the noise of the readings.
            std_scaled: Parts of them from errors that the tolerance scale multiplies.
        """
        return expanded_uncertainty(
            std,
            std_scatter,
            std_scaled,
            noise_factor=self.noise_coverage,
            contrasts=self.tolerance_scale.contrasts,
        )

    @property
    def intervals(self) -> tuple[tuple[float, float], ...]:
        """Values of `free` ± their expanded uncertainties, [SI].

        Bounds truncate the distribution of an estimate: backlash is never negative.
        """
        half = self.expanded_uncertainties.tolist()
        return tuple(
            bounded_interval(
                p.value,
                u,
                -math.inf if p.lower is None else p.lower,
                math.inf if p.upper is None else p.upper,
            )
            for p, u in zip(self.free, half, strict=True)
        )

    @property
    def active_offsets(self) -> Array:
        """Active offsets while measuring, shape (n_drives,), [m, rad]; 0 if not stated."""
        stated = self.session.controller_offsets
        return np.zeros(len(self.robot.drives)) if stated is None else np.array(stated)

    @property
    def measured_again(self) -> bool:
        """True if sessions with different active offsets were joined."""
        active = tuple(self.active_offsets.tolist())
        return any(s.active is not None and s.active != active for s in self.setups)

    def noise_factor(self, row: ResidualRow) -> float:
        """Standard deviation of a row over that of one reading: √2 for a difference, else 1."""
        if row.minus is None:
            return 1.0
        sensor = next(s.sensor for s in self.setups if s.name == row.setup)
        return math.sqrt(1.0 + is_difference(row.minus, sensor))

    def row_sigma(self, row: ResidualRow) -> float:
        """Standard deviation of a row by the noise of its gauge, [m]."""
        gauge = next(s.gauge for s in self.setups if s.name == row.setup)
        noise = next(g.noise for g in self.gauges if g.name == gauge)
        return noise.sigma * self.noise_factor(row)

    def displacement(self, displayed: ArrayLike, approach: str | None = None) -> Array:
        """Displacement of the drives by the controller's compensation while measuring.

        Args:
            displayed: Commanded drive coordinates with the active offsets, shape (K, n_drives),
                [m, rad].
            approach: Sides of approach as for `UseConditions`.

        Returns:
            Displacements, shape (K, n_drives), [m, rad]; see `orthocal.effects.compensation`.
        """
        coordinates = np.asarray(displayed, dtype=np.float64)
        if not self.session.compensation:
            return np.zeros(coordinates.shape)
        sides = [APPROACH[letter] for letter in approach or "u" * coordinates.shape[1]]
        return displace_drives(
            self.robot,
            self.session.compensation,
            coordinates,
            np.tile(sides, (len(coordinates), 1)),
        )

    @property
    def compensated_backlash(self) -> Array:
        """Backlash that the controller compensated while measuring, at the mechanical zero.

        Shape (n_drives,), [m, rad].
        """
        zero = self.robot.drive_zero[None]
        outward, inward = (self.displacement(zero, side * zero.size)[0] for side in "pn")
        return np.asarray(outward - inward)

    @property
    def only_offsets(self) -> bool:
        """True if the identified machine has no errors except offsets."""
        are_offsets = self.robot.parameters.are_offsets
        return all(are_offsets(p.name) for p in self.parameters if p.free or p.value != 0.0)

    @property
    def offset_weights(self) -> Array:
        """Contribution of each parameter to the drive offsets, shape (n_drives, n_parameters)."""
        drives = [f"{d.name}.offset" for d in self.robot.drives]
        return self.robot.parameters.coefficients(drives, [p.name for p in self.parameters])

    @property
    def offsets(self) -> Array:
        """Offsets of the identified machine's drives, shape (n_drives,), [m, rad]."""
        return np.asarray(self.offset_weights @ np.array([p.value for p in self.parameters]))

    @property
    def machine(self) -> Machine:
        """The identified machine: forward and inverse kinematics with its errors."""
        return Machine(self.robot, self.errors)

    def _repr_html_(self) -> str:
        """Short answer for a notebook."""
        import orthocal  # here, as the output depends on this module

        return orthocal.summarize(self, html=True)


def require_calibration(value: object) -> None:
    """Raise a TypeError unless an argument is a calibration."""
    expected = "a Calibration, such as load_calibration(...)"
    require_kind(value, Calibration, expected=expected)


def propagate_stds(gain: Array, covariances: Sequence[Array]) -> Array:
    """Standard deviations of linear functions of errors, shape (n_covariances, n_functions).

    Args:
        gain: Derivatives of the functions, shape (n_functions, m). Errors that no function depends
            on may have unknown variances.
        covariances: Covariances of the errors, shape (n, n) each with n >= m, such as
            `error_covariances`.
    """
    stds = np.zeros((len(covariances), len(gain)))
    for i, row in enumerate(gain):
        used = np.flatnonzero(row)
        for k, covariance in enumerate(covariances):
            variance = row[used] @ covariance[np.ix_(used, used)] @ row[used]
            stds[k, i] = np.sqrt(np.maximum(variance, 0.0))
    return stds
