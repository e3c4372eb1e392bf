"""Calibration of a machine after mechanical adjustments."""

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
    """Calibration of a machine after mechanical adjustments; not assessed.

    The amounts become known parameters. The errors with which they were set increase the covariance
    of the free errors of the geometry to C + T S Tᵀ. S is the covariance of the amounts, and T the
    coefficients of the amounts in the errors.

    Args:
        calibration: Calibration of the machine before the adjustments.
        amounts: Adjustment to its amount, [m].
    """
    if not amounts:
        return calibration
    robot = calibration.robot
    chosen = [a for a in find_adjustments(robot) if a.name in amounts]
    terms = robot.parameters.coefficients(
        [p.name for p in calibration.free], [a.parameter for a in chosen]
    )
    root = terms * [a.setting_std(amounts[a.name]) for a in chosen]
    known_values = {p.name: p.value for p in calibration.parameters if not p.free}
    held = {a.parameter: known_values.get(a.parameter, 0.0) + amounts[a.name] for a in chosen}
    covariance = calibration.model_covariance + root @ root.T
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
