"""Scale of the tolerances: the factor by which the errors of a machine exceed them.

One factor η multiplies the prior standard deviations of all errors of the geometry except offsets,
whether they are estimated or not. It is estimated from the readings (`assessment/judgement.py`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from orthocal.arrays import Array
from orthocal.io.documents import PositiveInSI
from orthocal.io.fields import FileRecord, SizeOrInf
from orthocal.robot.parameters import ParameterSet


@dataclass(frozen=True, slots=True)
class ToleranceScale(FileRecord):
    """Factor on the tolerances, and the information from which it was estimated."""

    factor: PositiveInSI = 1.0
    """Factor; 1 if errors within the tolerances explain the readings."""
    contrasts: SizeOrInf = math.inf
    """Effective number of independent contrasts of the readings that determine the factor; infinite
    for a factor of 1."""

    def factors(self, parameters: ParameterSet, names: tuple[str, ...]) -> Array:
        """Factor on the prior standard deviation of each parameter, shape (n_names,)."""
        return np.array([self.factor if parameters.are_scaled(n) else 1.0 for n in names])


AS_STATED = ToleranceScale()
"""Scale of unchanged tolerances."""

SCALE_RATIO = 30.0 ** (1.0 / 85.0)
"""Ratio of neighbouring trial scales: 4 %, far less than the uncertainty of an estimated scale."""


def trial_scales(lowest: float, highest: float) -> Array:
    """Trial values of the tolerance scale: powers of SCALE_RATIO from lowest to highest."""
    # rounded, so that a limit that is a power itself is among them
    first, last = (round(math.log(v) / math.log(SCALE_RATIO), 9) for v in (lowest, highest))
    return np.asarray(SCALE_RATIO ** np.arange(math.ceil(first), math.floor(last) + 1))
