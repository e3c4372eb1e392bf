"""Scale of the tolerances: the factor by which the errors of a machine exceed them.

One factor η, found from the readings (`assessment/judgement.py`), multiplies the prior standard
deviations of all errors of the geometry except offsets: those that are estimated, and those that
are not.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from orthocal.arrays import Array
from orthocal.io.documents import PositiveInSI
from orthocal.io.fields import CLOSED, SizeOrInf
from orthocal.robot.parameters import ParameterSet


@dataclass(frozen=True, slots=True)
class ToleranceScale:
    """Factor on the tolerances, and from how much it was estimated."""

    __pydantic_config__ = CLOSED

    factor: PositiveInSI = 1.0
    """1 if the readings are possible within the tolerances."""
    contrasts: SizeOrInf = math.inf
    """Effective number of independent contrasts of the readings that determine it; infinite for a
    factor of 1."""

    def factors(self, parameters: ParameterSet, names: tuple[str, ...]) -> Array:
        """Factor on the prior standard deviation of each parameter, shape (n_names,)."""
        return np.array([self.factor if parameters.are_scaled(n) else 1.0 for n in names])


AS_STATED = ToleranceScale()
"""Tolerances as stated."""
