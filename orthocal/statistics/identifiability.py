"""Identifiability of parameters: rank, indistinguishable parameters, base parameters.

The analysis uses the identification Jacobian with gauge zeros eliminated and columns scaled by the
prior standard deviations (std) of the parameters. A direction is resolvable if one prior std
changes the readings, as a vector, by more than the noise of one reading. The readings are then
more informative than the prior.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import compress
from typing import Annotated

import numpy as np
from pydantic import BeforeValidator, Field, PlainSerializer

from orthocal.arrays import Array
from orthocal.io.documents import Count, Number
from orthocal.io.fields import FileRecord, Many, Size, Vector, read_only
from orthocal.robot.parameters import Parameter
from orthocal.statistics.information import RANK_THRESHOLD, Information

NEGLIGIBLE = 1e-9
"""Coefficient of a combination, in units of prior std, below which it is a rounding error."""

EQUAL_NORMS = 1e-9
"""Relative difference of the norms of two columns below which it is a rounding error."""


@dataclass(frozen=True, slots=True, eq=False)
class Combination:
    """Linear combination of parameters that the readings determine only as a sum."""

    terms: Annotated[tuple[tuple[str, Number], ...], Field(min_length=1)]
    """Parameter and coefficient, the first 1, [unit of the first per unit of the parameter]."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters."""
        return tuple(name for name, _ in self.terms)

    @property
    def formula(self) -> str:
        """Formula of the sum, such as "x_slide.offset + x_swivel.x − 0.31 x_slide.ry"."""
        return self.shorten(None)

    def shorten(self, max_terms: int | None) -> str:
        """Formula with at most `max_terms` terms, the largest coefficients first; None for all."""
        (text, _), *others = self.terms
        omitted: list[tuple[str, float]] = []
        if max_terms is not None:
            others.sort(key=lambda term: -abs(term[1]))
            others, omitted = others[: max_terms - 1], others[max_terms - 1 :]
        for name, coefficient in others:
            size = f"{abs(coefficient):.3g}"
            factor = "" if size == "1" else f"{size} "
            text += f" {'+' if coefficient > 0 else '−'} {factor}{name}"
        if not omitted:
            return text
        return f"{text} and {len(omitted)} more, of at most {abs(omitted[0][1]):.2g} each"

    @property
    def words(self) -> str:
        """Description of what the readings determine, such as "a and b: only their sum"."""
        if len(self.terms) == 2 and f"{abs(self.terms[1][1]):.3g}" == "1":
            kind = "sum" if self.terms[1][1] > 0 else "difference"
            return f"{self.terms[0][0]} and {self.terms[1][0]}: only their {kind}"
        if len(self.terms) == 1:
            return f"{self.terms[0][0]}: by itself"
        return f"{', '.join(self.names[:-1])} and {self.names[-1]}: only {self.formula}"


Recorded = Annotated[
    Combination,
    BeforeValidator(lambda terms: {"terms": terms}),
    PlainSerializer(lambda combination: combination.terms),
]
"""Combination that is recorded as pairs of parameter and coefficient."""


@dataclass(frozen=True, slots=True, eq=False)
class Identifiability(FileRecord):
    """Identifiability of the free parameters from the readings."""

    singular_values: Vector
    """Singular values of the scaled identification Jacobian, descending, shape (n_free,), [m of
    the gauge with the least noise per prior std]. If base parameters were estimated, of their
    columns."""
    threshold: Number
    """Smallest singular value of a resolvable direction, in the unit of the singular values."""
    rank: Count
    """Number of singular values above the threshold."""
    structural_rank: Count
    """Rank for readings without noise. If base parameters were estimated, of all parameters."""
    n_postures: Annotated[Count, Field(ge=1)]
    """Number of postures of the session."""
    n_readings: Count
    """Number of independent readings: readings minus repetitions and gauge zeros."""
    n_nuisance: Size
    """Effective number of nuisance parameters, with their priors: independent readings that
    determine them instead of errors of the machine."""
    below_noise: Many[str]
    """Parameters that change the readings by less than the threshold."""
    resolvable: Many[str]
    """Parameters whose standard deviation from the readings alone is below the prior one."""
    alike: Many[Recorded]
    """Groups of parameters with proportional effects on the readings, which determine only a sum of
    each group."""
    base: Many[Recorded]
    """Base parameters by QR decomposition with pivoting."""

    @property
    def condition(self) -> float:
        """Condition number of the resolvable directions; infinite if there are none."""
        resolvable = self.singular_values[: self.rank]
        return float(resolvable[0] / resolvable[-1]) if self.rank else float("inf")

    @property
    def observability(self) -> dict[str, float]:
        """Observability indices O1 to O5 of the resolvable directions.

        O1 = (∏ s)^(1/r)/√postures (Borm and Menq 1991), O2 = s_r/s_1 (Driels and Pathre 1990, [1]),
        O3 = s_r and O4 = s_r²/s_1 (Nahvi and Hollerbach 1994, 1996), O5 = 1/Σ 1/s (Sun and
        Hollerbach 2008). O2 is a number; the others have the unit of the singular values. All are 0
        without resolvable directions. The indices do not compare plans with different numbers r of
        resolvable directions.
        """
        s = self.singular_values[: self.rank]
        if not self.rank:
            return dict.fromkeys(("O1", "O2", "O3", "O4", "O5"), 0.0)
        return {
            "O1": float(np.exp(np.log(s).mean()) / np.sqrt(self.n_postures)),
            "O2": float(s[-1] / s[0]),
            "O3": float(s[-1]),
            "O4": float(s[-1] ** 2 / s[0]),
            "O5": float(1.0 / (1.0 / s).sum()),
        }


def analyse_identifiability(
    information: Information,
    parameters: Sequence[Parameter],
    *,
    sigma: float,
    n_postures: int,
    n_readings: int,
    n_nuisance: float = 0.0,
) -> Identifiability:
    """Analyse an identification Jacobian.

    Args:
        information: The Jacobian with gauge zeros eliminated.
        parameters: The free parameters in the order of its columns.
        sigma: Standard deviation of a reading, which is the threshold, [m]; 0 or NaN for readings
            without noise.
        n_postures: Postures of the session.
        n_readings: Independent readings of the session.
        n_nuisance: Effective number of nuisance parameters.
    """
    factor, s = information.factor, information.singular_values
    smallest = RANK_THRESHOLD * float(s[0])
    threshold = max(sigma, smallest) if sigma > 0.0 else smallest
    norms = np.linalg.norm(factor, axis=0)
    names = [p.name for p in parameters]
    resolvable = information.determined(sigma=threshold if sigma > 0.0 else np.nan)
    return Identifiability(
        singular_values=read_only(s),
        threshold=threshold,
        rank=int((s > threshold).sum()),
        structural_rank=information.rank,
        n_postures=n_postures,
        n_readings=n_readings,
        n_nuisance=n_nuisance,
        below_noise=tuple(compress(names, norms <= threshold)),
        resolvable=tuple(compress(names, resolvable)),
        alike=_find_alike(factor, parameters, threshold),
        base=find_base_parameters(factor, parameters, threshold=threshold),
    )


def find_base_parameters(
    factor: Array, parameters: Sequence[Parameter], *, threshold: float
) -> tuple[Combination, ...]:
    """Base parameters by QR decomposition with column pivoting (Gautier 1991).

    J P = Q [R₁ R₂] with permutation P, so that J θ̂ = Q R₁ (θ̂₁ + R₁⁻¹ R₂ θ̂₂). The readings determine
    one sum for each column of R₁: a leading parameter plus multiples of the others.

    Args:
        factor: The Jacobian with gauge zeros eliminated, shape (n, n_free), [m per prior std].
        parameters: The free parameters in the order of its columns.
        threshold: Smallest norm of a column of R₁, orthogonal to the columns before it, [m].
    """
    if not np.any(factor):
        return ()
    singular_values = np.linalg.svd(factor, compute_uv=False)
    # no diagonal element of R₁ is smaller than the smallest singular value
    if len(singular_values) == factor.shape[1] and singular_values[-1] > threshold * (1.0 + 1e-9):
        return tuple(Combination(((p.name, 1.0),)) for p in parameters)  # all are resolvable
    from scipy import linalg

    # rounding errors must not decide between equal columns: earlier parameters precede
    preference = 1.0 - EQUAL_NORMS * np.arange(factor.shape[1])
    _, order = linalg.qr(factor * preference, mode="r", pivoting=True)
    (r,) = linalg.qr(factor[:, order], mode="r")
    diagonal = np.abs(np.diag(r))
    count = int((diagonal > threshold).sum())
    if not count:
        return ()
    coefficients = linalg.solve_triangular(r[:count, :count], r[:count, count:])
    combinations = []
    for i in range(count):
        lead = parameters[order[i]]
        terms = [(lead.name, 1.0)]
        for j in np.flatnonzero(np.abs(coefficients[i]) > NEGLIGIBLE):
            other = parameters[order[count + j]]
            coefficient = coefficients[i, j] * lead.prior_std / other.prior_std
            terms.append((other.name, float(coefficient)))
        combinations.append(Combination(tuple(terms)))
    position = {p.name: i for i, p in enumerate(parameters)}
    return tuple(sorted(combinations, key=lambda c: position[c.terms[0][0]]))


def _find_alike(
    factor: Array, parameters: Sequence[Parameter], threshold: float
) -> tuple[Combination, ...]:
    """Groups of parameters whose columns are multiples of each other within the threshold."""
    norms = np.linalg.norm(factor, axis=0)
    products = factor.T @ factor
    # rounding errors must not decide between equal norms
    steps = np.round(norms / (EQUAL_NORMS * (norms.max(initial=0.0) or 1.0)))
    order = np.argsort(-steps, kind="stable")
    pending = [int(i) for i in order if norms[i] > threshold]
    groups = []
    while pending:
        lead, *others = pending
        slope = products[lead, others] / norms[lead] ** 2
        # squared distances of the columns from multiples of the leading one
        square = norms[others] ** 2 - slope**2 * norms[lead] ** 2
        # half of the digits cancel in a difference of squares
        floor = (1e-7 * norms[others]) ** 2
        proportional = square <= np.maximum(threshold**2, floor)
        members = sorted([lead, *compress(others, proportional)])
        if len(members) > 1:
            first = members[0]
            terms = []
            for i in members:
                scaled = products[lead, i] / products[lead, first]
                ratio = scaled * parameters[first].prior_std / parameters[i].prior_std
                terms.append((parameters[i].name, float(ratio)))
            groups.append((first, Combination(tuple(terms))))
        pending = list(compress(others, ~proportional))
    return tuple(c for _, c in sorted(groups, key=lambda f: f[0]))
