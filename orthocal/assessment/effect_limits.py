"""Limits of effects, such as backlash, after taken or planned readings."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from orthocal.effects.loading import identified_effects
from orthocal.effects.protocol import Effect
from orthocal.estimation.problem import CalibrationProblem
from orthocal.session.session import Session
from orthocal.statistics.information import VAGUE, Information
from orthocal.statistics.zeros import project_out_zeros
from orthocal.units import LIMIT, Unit

DETERMINED = 0.9
"""Ratio of the limits after and before the readings below which a parameter is determined."""


@dataclass(frozen=True, slots=True)
class EffectLimits:
    """Largest limits of the parameters of an effect with one unit, ±2 standard deviations."""

    effect: str
    words: str
    """Effect in words."""
    unit: Unit
    """SI unit of the parameters."""
    count: int
    """Number of parameters."""
    before: float
    """Largest of their limits by the tolerances, [SI]."""
    after: float
    """Largest of their limits after the readings, [SI]."""

    @property
    def determined(self) -> bool:
        """True if the readings determine the parameters."""
        return self.after < DETERMINED * self.before


def parameter_units(effect: Effect, session: Session) -> dict[str, Unit]:
    """Parameters of an effect, those of each setup included, with their SI units."""
    of_setups = {
        f"setup.{setup}.{e.name}": e.unit for e in effect.setup_errors for setup in session.setups
    }
    return {e.name: e.unit for e in effect.errors} | of_setups


def find_limits(problem: CalibrationProblem, noise: float) -> tuple[EffectLimits, ...]:
    """Limits of the parameters of effects after the readings of a problem.

    The limits are computed to first order about the nominal machine. A parameter that is never
    negative is treated as one with a normal prior.

    Args:
        problem: Calibration problem with priors.
        noise: Standard deviation of a reading, [m].
    """
    effects = identified_effects(problem.session.robot)
    if not effects:
        return ()
    _, jacobian = problem.predict_and_jacobian(problem.active_theta)
    projected = project_out_zeros(jacobian, problem.observations)
    precision = np.maximum(problem.prior_precision, VAGUE)
    variance = np.diag(
        Information(projected).posterior(sigma=noise, precision=precision).covariance
    )
    after = LIMIT * np.sqrt(variance) * problem.theta_scale
    before = LIMIT * problem.theta_scale
    limits = []
    for effect in effects:
        units = parameter_units(effect, problem.session)
        for unit in dict.fromkeys(units.values()):
            columns = [i for i, n in enumerate(problem.free) if units.get(n) == unit]
            if columns:
                largest = before[columns].max(), after[columns].max()
                limits.append(
                    EffectLimits(
                        effect.name, effect.describe(), unit, len(columns), *map(float, largest)
                    )
                )
    return tuple(limits)
