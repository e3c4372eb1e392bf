"""Linear identification: equation (8) of the paper, and linearised solutions of problems.

Paper: Pashkevich, Chablat and Wenger, Kinematic calibration of Orthoglide-type mechanisms, 2006.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from orthocal.arrays import Array, Mask
from orthocal.errors import NotIdentifiableError, SessionError, UnreachableError
from orthocal.estimation.problem import CalibrationProblem
from orthocal.statistics.information import RANK_THRESHOLD, Information, decompose
from orthocal.statistics.zeros import project_out_zeros
from orthocal.units import MM

TWELVE_ROWS = tuple(
    f"{row}{sign}"
    for rows in (("xy", "yx"), ("yz", "zy"), ("xz", "zx"))
    for sign in "+-"
    for row in rows
)
"""Names of the rows of equation (8): direction, leg and sign.

Row "xy+" is Δx_y: the reading in direction x on leg y in the maximum posture, minus that in the
mechanical zero. "-" is the minimum posture instead. The last block is (Δx_z, Δz_x).
"""

SMALLEST_NORM = 1e-12
"""Smallest norm of the residuals by which a problem with bounds is divided, [m], or [1] with a
prior."""

SIX_ROWS = ("xy", "xz", "yx", "yz", "zx", "zy")
"""Names of the rows of the reduced system: maximum minus minimum posture.

The order is that of the paper's Table 1.
"""


def displacement_angle(displacement: float, *, length: float) -> float:
    """Angle α by which the other two legs incline when the tool moves along an axis.

    With the drive coordinate ρ_min of the minimum posture, α_min = asin((ρ_min − L)/L) is negative.
    The paper prints asin(ρ_min/L), which is a misprint.

    Args:
        displacement: Signed displacement of the tool from the mechanical zero, [m].
        length: Leg length L, [m].

    Raises:
        UnreachableError: If the displacement is not below the leg length.
    """
    if not abs(displacement) < length:
        raise UnreachableError(
            f"a displacement of {displacement / MM:g} mm is out of reach of legs of "
            f"{length / MM:g} mm"
        )
    return float(np.arcsin(displacement / length))


def leg_parallelism_matrix(
    *,
    length: float,
    displacement_max: float,
    displacement_min: float,
    rows: Literal[6, 12] = 12,
    fraction_from_tcp: float = 0.5,
) -> Array:
    """Jacobian of differences of readings with respect to the drive offsets, equation (8).

        Δy_x = c Δρ_x + b Δρ_y,  b = sin α,  c = (1 − μ + sin α) tan α

    Δy_x is a difference of readings in direction y on leg x, Δρ_x the offset of drive x, and α the
    result of `displacement_angle`. With μ = 0.5 this is equation (7).

    Args:
        length: Leg length L, [m].
        displacement_max: Displacement of the tool in the maximum postures, [m].
        displacement_min: Displacement in the minimum postures, negative, [m].
        rows: 12 for differences from the mechanical zero (order TWELVE_ROWS), 6 for maximum minus
            minimum (order SIX_ROWS).
        fraction_from_tcp: μ, position of the gauge along the leg in the mechanical zero: 0 at the
            tip, 1 at the root of the leg.

    Returns:
        Shape (rows, 3), [m/m].

    Raises:
        UnreachableError: If a displacement is not below the leg length.
    """
    coefficients = {}
    for sign, displacement in (("+", displacement_max), ("-", displacement_min)):
        alpha = displacement_angle(displacement, length=length)
        b = np.sin(alpha)
        coefficients[sign] = (b, (1.0 - fraction_from_tcp + b) * np.tan(alpha))

    def row(name: str) -> Array:
        direction, leg, sign = tuple(name)
        b, c = coefficients[sign]
        result = np.zeros(3)
        result["xyz".index(leg)] = c
        result["xyz".index(direction)] = b
        return result

    if rows == 12:
        return np.array([row(name) for name in TWELVE_ROWS])
    return np.array([row(name + "+") - row(name + "-") for name in SIX_ROWS])


def twelve_row_covariance() -> Array:
    """Covariance of the twelve differences for readings of variance 1, shape (12, 12).

    Both differences of one setup share the reading in the mechanical zero: [[2, 1], [1, 2]].
    """
    same_setup = np.array([[a[:2] == b[:2] for b in TWELVE_ROWS] for a in TWELVE_ROWS])
    return same_setup.astype(np.float64) + np.eye(len(TWELVE_ROWS))


def invert_equation_8(matrix: ArrayLike, *, covariance: ArrayLike | None = None) -> Array:
    """Matrix G of the least-squares solution Δρ = G y of equation (8), shape (3, rows).

    Args:
        matrix: Result of `leg_parallelism_matrix`, shape (rows, 3).
        covariance: V, covariance of the rows up to a factor, shape (rows, rows), for generalised
            least squares; ordinary least squares by default.

    Raises:
        NotIdentifiableError: If the rows do not determine the three offsets.
    """
    a = np.asarray(matrix, dtype=np.float64)
    if np.linalg.matrix_rank(a, rtol=RANK_THRESHOLD) < 3:
        raise NotIdentifiableError(
            "the rows do not determine the three offsets",
            parameters=("x_slide.offset", "y_slide.offset", "z_slide.offset"),
        )
    if covariance is None:
        return np.asarray(np.linalg.pinv(a))
    whiten = np.linalg.inv(np.linalg.cholesky(np.asarray(covariance, dtype=np.float64)))
    return np.asarray(np.linalg.pinv(whiten @ a) @ whiten)


@dataclass(frozen=True, slots=True, eq=False)
class LinearProblem:
    """Problem linearised about the active offsets of the controller.

    Entries are single readings, scaled to the noise of the first gauge (`CalibrationProblem`).
    """

    problem: CalibrationProblem
    """The problem."""
    residual: Array
    """Measured minus predicted readings y − h, gauge zeros eliminated, shape (n_entries,),
    [noise-scaled m] (see `CalibrationProblem`)."""
    jacobian: Array
    """dh/dθ̂, with θ̂ the free parameters in prior standard deviations, gauge zeros eliminated,
    shape (n_entries, n_free), [noise-scaled m per prior std]."""
    information: Information
    """Information of the Jacobian."""

    def solve(self, *, sigma: float, use: Mask | None = None) -> Array:
        """Solve the linearised problem by least squares with its prior and bounds.

        Args:
            sigma: Standard deviation of one reading, [m]; used only with a prior.
            use: Mask of the entries to use, shape (n_entries,); must contain all entries of a zero
                or none. All by default.

        Returns:
            Free parameters, shape (n_free,), [SI].
        """
        problem = self.problem
        rows = slice(None) if use is None else use
        jacobian, residual = self.jacobian[rows], self.residual[rows]
        if len(jacobian) > 2 * problem.n_free:
            # the factor R of a QR decomposition has the same least-squares solution
            r = np.asarray(np.linalg.qr(np.column_stack([jacobian, residual]), mode="r"))
            jacobian, residual = r[:, :-1], r[:, -1]
        reference = problem.active_theta / problem.theta_scale
        weight = np.sqrt(problem.prior_precision)
        if problem.has_prior:
            mean = problem.prior_mean / problem.theta_scale
            jacobian = np.vstack([jacobian / sigma, np.diag(weight)])
            residual = np.concatenate([residual / sigma, weight * (mean - reference)])
        bounds = problem.selection.lower, problem.selection.upper
        lower, upper = (b / problem.theta_scale - reference for b in bounds)
        step = np.linalg.lstsq(jacobian, residual, rcond=RANK_THRESHOLD)[0]
        if ((step < lower) | (step > upper)).any():
            from scipy.optimize import lsq_linear

            # the tolerance of lsq_linear is absolute
            unit = max(float(np.linalg.norm(residual)), SMALLEST_NORM)
            options = {"bounds": (lower, upper), "method": "bvls", "tol": 1e-15}
            step = lsq_linear(jacobian / unit, residual / unit, **options).x
        return np.asarray((reference + step) * problem.theta_scale)


def linearise_problem(problem: CalibrationProblem) -> LinearProblem:
    """Linearise a problem about the active offsets of the controller.

    Raises:
        ClosureError: If a posture cannot be reached with the active offsets.
        SessionError: If a predicted reading or its derivative is not finite.
    """
    prediction, jacobian = problem.predict_and_jacobian(
        problem.active_theta, problem.active_passive
    )
    require_finite(problem, prediction, jacobian)
    return LinearProblem(
        problem,
        project_out_zeros(problem.values - prediction, problem.observations),
        project_out_zeros(jacobian, problem.observations),
        decompose(jacobian, problem.observations),
    )


def require_finite(problem: CalibrationProblem, prediction: Array, jacobian: Array) -> None:
    """Refuse predicted readings and derivatives that are not finite.

    They are not finite if a tip does not touch its rod.

    Args:
        problem: The problem.
        prediction: Predicted readings, shape (n_entries,), [noise-scaled m].
        jacobian: Derivatives of the readings, shape (n_entries, n).

    Raises:
        SessionError: If a number is not finite; names setup and posture of the first one.
    """
    bad = np.flatnonzero(~(np.isfinite(prediction) & np.isfinite(jacobian).all(axis=1)))
    if not bad.size:
        return
    o, session = problem.observations, problem.session
    setup = list(session.setups)[o.setup[bad[0]]]
    posture = list(session.postures)[o.posture[bad[0]]]
    raise SessionError(
        f"the predicted reading in posture '{posture}' or its derivative is not finite, for the "
        "nominal machine with the active offsets; check that the tip touches the rod there",
        where=f"{session.path or 'session'}: setups.{setup}",
    )
