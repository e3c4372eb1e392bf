"""Manual alignment: the operator centres a ball on the actual rod, not on its nominal position.

Some nuisance parameters are deviations from the aligned position, which depends on the errors of
the machine in the alignment posture (`Session.alignment_postures`). To first order,

    ν = ν_deviation + S (θ − θ_active)

with S the sensitivity of a virtual sensor in that posture, and θ_active the offsets that the
controller already applies. In a session before mechanical adjustments, θ are the errors of the
machine at that time. Second-order terms are some hundredths of a millimetre for offsets of
millimetres, far below the uncertainty of alignment by eye.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from orthocal.arrays import Array, Mask
from orthocal.observation.sensor_groups import NuisanceParameters
from orthocal.session.session import Posture, Reading, Session, Setup


@dataclass(frozen=True, slots=True, eq=False)
class ManualAlignment:
    """Nuisance parameters of aligned gauges as functions of the machine's errors."""

    sensitivity: Array
    """S, derivative with respect to all elementary errors, shape (n_nuisance, n_errors), [SI]."""
    start: Array
    """Value for θ = 0: −S θ_active, plus the effect of mechanical adjustments between the setup and
    the end of the session, shape (n_nuisance,), [SI]."""

    def __call__(self, errors: Array) -> Array:
        """Nuisance parameters of aligned gauges.

        Args:
            errors: Elementary errors, shape (..., n_errors), [SI].

        Returns:
            Shape (..., n_nuisance), [SI].
        """
        return np.asarray(errors @ self.sensitivity.T + self.start)

    @property
    def aligned(self) -> Mask:
        """Mask of the nuisance parameters that are aligned by eye, shape (n_nuisance,)."""
        return np.asarray(self.sensitivity.any(axis=1))


@dataclass(frozen=True, slots=True, eq=False)
class Alignment:
    """Nuisance parameter and the virtual sensor with which it is aligned."""

    parameter: int
    """Index of the nuisance parameter."""
    setup: Setup
    """Setup with the virtual sensor."""
    posture: Posture
    """Alignment posture with the active offsets added, for the nominal machine."""
    active: Array
    """Active offsets, shape (n_drives,), [m, rad]."""


def list_alignments(session: Session, nuisance: NuisanceParameters) -> list[Alignment]:
    """Alignments of a session's gauges, each in the alignment posture of its setup."""
    aligned_at = session.alignment_postures
    active = session.robot.drive_zero - session.zero_drives
    result = []
    for i, setup in enumerate(session.setups.values()):
        if not nuisance.of_setup[i]:  # without readings
            continue
        virtual = setup.sensor.aligned_to(session.robot)
        # not strict: parameters of effects follow those of the sensor, and are not aligned
        for index, parameter in zip(
            nuisance.of_setup[i], setup.sensor.nuisance_parameters, strict=False
        ):
            if parameter.name in virtual:
                posture = session.postures[aligned_at[setup.name]]
                result.append(
                    Alignment(
                        parameter=index,
                        setup=replace(setup, sensor=virtual[parameter.name], active=None),
                        posture=replace(posture, drives=posture.drives + active[i]),
                        active=active[i],
                    )
                )
    return result


def virtual_session(session: Session, alignments: Sequence[Alignment]) -> Session:
    """Session with one reading of the virtual sensor of each alignment."""
    names = [str(i) for i in range(len(alignments))]
    return replace(
        session,
        setups={n: replace(a.setup, name=n) for n, a in zip(names, alignments, strict=True)},
        postures={n: a.posture for n, a in zip(names, alignments, strict=True)},
        readings=tuple(Reading(n, n, None, 1, 0.0, None) for n in names),
        controller_offsets=None,
    )
