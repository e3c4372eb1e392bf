"""A calibrated machine after mechanical adjustments."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from orthocal.calibration.build_record import hold_parameter
from orthocal.calibration.calibration import Calibration
from orthocal.calibration.records import ParameterEstimate
from orthocal.effects.adjustment import find_adjustments
from orthocal.io.fields import read_only


def adjust_calibration(calibration: Calibration, amounts: Mapping[str, float]) -> Calibration:
    """The calibration of a machine as it is after mechanical adjustments; not assessed.

    The amounts are held as known parameters. The errors with which they were set increase the
    covariance of the free errors of the geometry: C + T S Tᵀ, with T their terms in these errors.

    Args:
        calibration: The calibration of the machine before.
        amounts: Adjustment to its amount, [m].
    """
    if not amounts:
        return calibration
    robot = calibration.robot
    chosen = [a for a in find_adjustments(robot) if a.name in amounts]
    terms = robot.parameters.coefficients(
        [p.name for p in calibration.free], [a.parameter for a in chosen]
    )
    spread = terms * [a.setting_std(amounts[a.name]) for a in chosen]
    before = {p.name: p.value for p in calibration.parameters if not p.free}
    held = {a.parameter: before.get(a.parameter, 0.0) + amounts[a.name] for a in chosen}
    covariance = calibration.model_covariance + spread @ spread.T
    variances = iter(np.diag(covariance + calibration.unmodelled.bias_covariance).tolist())

    def estimate(p: ParameterEstimate) -> ParameterEstimate:
        return replace(p, std=float(np.sqrt(next(variances)))) if p.free else p

    return replace(
        calibration,
        parameters=(
            *(estimate(p) for p in calibration.parameters if p.name not in held),
            *(hold_parameter(robot, name, value) for name, value in held.items()),
        ),
        model_covariance=read_only(covariance),
        assessment=None,
    )
