"""Best pairs of readings of many candidate setups at once.

Setups of one gauge with equally many candidate readings are stacked. The gains are those of
`SetupGain.best_pairs`, with the alignment averaged over all postures. A plan takes 10 to 20 % less
time than with one setup at a time.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from orthocal.arrays import Array, Indices, Mask
from orthocal.planning.candidates import CandidateSetup
from orthocal.planning.information_gain import pair_gains
from orthocal.planning.ranking import first_largest_of_rows

PAIRS_AT_ONCE = 40_000
"""Number of pairs whose gains are computed together; their matrices stay in the cache."""


@dataclass(frozen=True, slots=True, eq=False)
class SetupStack:
    """Candidate setups of one gauge with m readings each."""

    gauge: str
    absolute: bool
    """Whether the gauge zero is known."""
    which: Indices
    """Indices of the candidate setups, shape (n_setups,)."""
    jacobian: Array
    """A of each setup, shape (n_setups, m, n_state)."""
    covariance: Array
    """D of each setup, shape (n_setups, m, m), [m²]."""
    possible: Mask
    """Mask of pairs within the gauge's range, shape (n_setups, m, m)."""
    within_range: Indices
    """Number of readings within the gauge's range if it begins in each reading,
    shape (n_setups, m)."""

    def best_pairs(
        self, covariance: Array, root: Array, noise: float, count: int
    ) -> list[tuple[float, int, tuple[int, int]]]:
        """Gain, candidate setup and best pair of readings of each setup that has a pair.

        Args:
            covariance: Covariance C of the state without these readings, shape (n_state, n_state).
            root: C R with the weight T = R Rᵀ, shape (n_state, p).
            noise: σ², [m²].
            count: Number of readings that the gauge's range must allow.
        """
        best: list[tuple[float, int, tuple[int, int]]] = []
        at_once = max(1, PAIRS_AT_ONCE // self.possible[0].size)
        for begin in range(0, len(self.which), at_once):
            some = slice(begin, begin + at_once)
            jacobian = self.jacobian[some]
            effect = jacobian @ root
            spread = (jacobian @ covariance) @ jacobian.mT
            spread += self.covariance[some]
            gains = pair_gains(effect @ effect.mT, spread, noise, absolute=self.absolute)
            possible = self.possible[some] & (self.within_range[some] >= count)[:, :, None]
            np.putmask(gains, ~possible, -1.0)
            gains = gains.reshape(len(gains), -1)
            at = first_largest_of_rows(gains)
            largest = gains[np.arange(len(at)), at].tolist()
            rows = (x.tolist() for x in np.divmod(at, self.possible.shape[1]))
            columns = zip(largest, self.which[some].tolist(), *rows, strict=True)
            best += [(gain, i, (j, k)) for gain, i, j, k in columns if gain >= 0.0]
        return best


def stack_setups(setups: Sequence[CandidateSetup], which: Iterable[int]) -> Iterator[SetupStack]:
    """Stack candidate setups whose readings are single numbers, by gauge and number of readings.

    Args:
        setups: All candidate setups.
        which: Indices of the setups to stack.
    """
    groups: dict[tuple[str, bool, int], list[int]] = {}
    for i in which:
        key = setups[i].gauge, setups[i].absolute, len(setups[i].rows)
        groups.setdefault(key, []).append(i)
    for (gauge, absolute, m), members in groups.items():
        reachable = np.stack([setups[i].reachable for i in members])
        yield SetupStack(
            gauge,
            absolute,
            np.array(members),
            jacobian=np.stack([setups[i].jacobian for i in members]),
            covariance=np.stack([setups[i].covariance for i in members]),
            possible=reachable & ~np.eye(m, dtype=np.bool_),
            within_range=reachable.sum(axis=2),
        )
