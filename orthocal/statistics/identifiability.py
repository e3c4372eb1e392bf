"""Identifiability of parameters: rank, indistinguishable parameters, base parameters.

The analysis uses the identification Jacobian with gauge zeros eliminated, each column scaled by the
prior std of its parameter. A direction is resolvable if one prior std along it changes all readings
together by more than the noise of one: then the readings are more informative than the prior.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from pydantic import BeforeValidator, Field, PlainSerializer

from orthocal.arrays import Array
from orthocal.io.documents import Count, Number
from orthocal.io.fields import CLOSED, Many, Vector
from orthocal.robot.parameters import Parameter
from orthocal.statistics.information import RANK_THRESHOLD, Information

NEGLIGIBLE = 1e-9
"""Coefficients of a combination below this, in prior std, are rounding."""


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
        """Formula of the sum: x_slide.offset + x_swivel.x − 0.31 x_slide.ry."""
        return self.shorten(None)

    def shorten(self, most: int | None) -> str:
        """Formula with at most `most` terms, the largest coefficients first."""
        others = sorted(self.terms[1:], key=lambda t: -abs(t[1])) if most else self.terms[1:]
        text = self.terms[0][0]
        for name, coefficient in others if most is None else others[: most - 1]:
            size = f"{abs(coefficient):.3g}"
            factor = "" if size == "1" else f"{size} "
            text += f" {'+' if coefficient > 0 else '−'} {factor}{name}"
        omitted = 0 if most is None else len(self.terms) - most
        if omitted <= 0:
            return text
        return f"{text} and {omitted} more, of at most {abs(others[(most or 1) - 1][1]):.2g} each"

    @property
    def words(self) -> str:
        """Description in words, such as a and b: only their sum."""
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
"""A combination as pairs of parameter and coefficient."""


@dataclass(frozen=True, slots=True, eq=False)
class Identifiability:
    """Identifiability of the free parameters by the readings."""

    __pydantic_config__ = CLOSED

    singular_values: Vector
    """Singular values of the scaled identification Jacobian, descending, shape (n_free,), [m per
    prior std]; with base parameters, of their columns."""
    threshold: Number
    """Smallest singular value of a resolvable direction, [m per prior std]."""
    rank: Count
    """Number of singular values above the threshold."""
    structural_rank: Count
    """Rank with perfect readings; with base parameters, of all parameters that they represent."""
    n_postures: Annotated[Count, Field(ge=1)]
    n_readings: Count
    """Independent readings: repeated ones once, minus gauge zeros."""
    unseen: Many[str]
    """Parameters that change the readings by less than the threshold."""
    resolvable: Many[str]
    """Parameters with a standard deviation below the prior one from the readings alone."""
    alike: Many[Recorded]
    """Groups of parameters with proportional effects: only their sum is resolvable."""
    base: Many[Recorded]
    """Base parameters by QR decomposition with pivoting."""

    @property
    def condition(self) -> float:
        """Largest over smallest singular value that counts; infinite if none does."""
        seen = self.singular_values[: self.rank]
        return float(seen[0] / seen[-1]) if self.rank else float("inf")

    @property
    def observability(self) -> dict[str, float]:
        """Observability indices O1 to O5 over the singular values that count, [m per prior std].

        O1 = (∏ s)^(1/r)/√postures (Borm and Menq 1991), O2 = s_r/s_1 (Driels and Pathre 1990, [1]),
        O3 = s_r and O4 = s_r²/s_1 (Nahvi and Hollerbach 1994, 1996), O5 = 1/Σ 1/s (Sun and
        Hollerbach 2008). 0 where nothing counts. Plans that see different numbers r of directions
        cannot be compared by any of them.
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
) -> Identifiability:
    """Analyse an identification Jacobian.

    Args:
        information: The Jacobian, zeros eliminated.
        parameters: The free parameters, in its order.
        sigma: Standard deviation of a reading, which is the threshold, [m]; 0 or NaN for perfect
            readings.
        n_postures: Postures of the session.
        n_readings: Independent readings of the session.
    """
    factor, s = information.factor, information.singular_values
    smallest = RANK_THRESHOLD * float(s[0])
    threshold = max(sigma, smallest) if sigma > 0.0 else smallest
    sizes = np.linalg.norm(factor, axis=0)
    names = [p.name for p in parameters]
    resolvable = information.determined(sigma=threshold if sigma > 0.0 else np.nan)
    return Identifiability(
        singular_values=s,
        threshold=threshold,
        rank=int((s > threshold).sum()),
        structural_rank=information.rank,
        n_postures=n_postures,
        n_readings=n_readings,
        unseen=tuple(n for n, size in zip(names, sizes, strict=True) if size <= threshold),
        resolvable=tuple(n for n, ok in zip(names, resolvable, strict=True) if ok),
        alike=_find_alike(factor, parameters, threshold),
        base=find_base_parameters(factor, parameters, threshold=threshold),
    )


def find_base_parameters(
    factor: Array, parameters: Sequence[Parameter], *, threshold: float
) -> tuple[Combination, ...]:
    """Base parameters by QR decomposition with column pivoting (Gautier 1991).

    J P = Q [R₁ R₂], so that J θ̂ = Q R₁ (θ̂₁ + R₁⁻¹ R₂ θ̂₂): the readings determine one sum
    for each counted column: a leading parameter and multiples of the others.

    Args:
        factor: The Jacobian, zeros eliminated, shape (n, n_free), [m per prior std].
        parameters: The free parameters, in its order.
        threshold: A column counts if what it adds to those before moves the readings together
            by more than this per prior std, [m].
    """
    if not np.any(factor):
        return ()
    sizes = np.linalg.svd(factor, compute_uv=False)
    if len(sizes) == factor.shape[1] and sizes[-1] > threshold * (1.0 + 1e-9):
        return tuple(Combination(((p.name, 1.0),)) for p in parameters)  # all are resolvable
    from scipy import linalg

    r, order = linalg.qr(factor, mode="r", pivoting=True)
    diagonal = np.abs(np.diag(r))
    count = int((diagonal > threshold).sum())
    if not count:
        return ()
    regroup = linalg.solve_triangular(r[:count, :count], r[:count, count:])
    result = []
    for i in range(count):
        lead = parameters[order[i]]
        terms = [(lead.name, 1.0)]
        for j in np.flatnonzero(np.abs(regroup[i]) > NEGLIGIBLE):
            other = parameters[order[count + j]]
            coefficient = regroup[i, j] * lead.prior_std / other.prior_std
            terms.append((other.name, float(coefficient)))
        result.append(Combination(tuple(terms)))
    place = {p.name: i for i, p in enumerate(parameters)}
    return tuple(sorted(result, key=lambda c: place[c.terms[0][0]]))


def _find_alike(
    factor: Array, parameters: Sequence[Parameter], threshold: float
) -> tuple[Combination, ...]:
    """Groups of columns that are multiples of one another within the threshold."""
    sizes = np.linalg.norm(factor, axis=0)
    products = factor.T @ factor
    pending = [int(i) for i in np.argsort(-sizes, kind="stable") if sizes[i] > threshold]
    groups = []
    while pending:
        lead, *others = pending
        slope = products[lead, others] / sizes[lead] ** 2
        square = sizes[others] ** 2 - slope**2 * sizes[lead] ** 2
        # a difference of squares loses half of the digits
        floor = (1e-7 * sizes[others]) ** 2
        proportional = square <= np.maximum(threshold**2, floor)
        members = sorted([lead, *(i for i, ok in zip(others, proportional, strict=True) if ok)])
        if len(members) > 1:
            first = members[0]
            terms = []
            for i in members:
                scaled = products[lead, i] / products[lead, first]
                ratio = scaled * parameters[first].prior_std / parameters[i].prior_std
                terms.append((parameters[i].name, float(ratio)))
            groups.append((first, Combination(tuple(terms))))
        pending = [i for i, ok in zip(others, proportional, strict=True) if not ok]
    return tuple(c for _, c in sorted(groups, key=lambda f: f[0]))
