"""What each reading, and the tool, answers to each error, in any posture.

The paper's factors among it: in its maximum postures the tool moves 1 along and tan α across with
the offset of the drive that moved (equation 6).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from orthocal.estimation.problem import CalibrationProblem, build_problem
from orthocal.kinematics.loop_closure import nominal_assembly
from orthocal.kinematics.sensitivity import ToolSensitivity
from orthocal.robot.model import Robot
from orthocal.session.session import Gauge, Posture, Reading, Session
from orthocal.study.paper import Displacements, build_paper_plan
from orthocal.study.runner import StudyTable
from orthocal.study.shipped_functions import ShippedSession
from orthocal.study.study import Columns, Study
from orthocal.units import MM, UM

Array = NDArray[np.float64]

TOOL = ("tool x", "tool y", "tool z")


@dataclass(frozen=True, eq=False)
class SensitivityStudy(Study):
    """First derivatives of all readings of a plan, and of the tool, about the nominal machine."""

    kind: ClassVar[str] = "sensitivity"
    counted: ClassVar[str] = "tables"

    session: ShippedSession
    names: tuple[str, ...]
    """Of the parameters."""

    @property
    def record(self) -> dict[str, Any]:
        """All that the table depends on."""
        return {**self.session.record, "parameters": list(self.names)}

    @property
    def task_sizes(self) -> tuple[int, ...]:
        """One: all of it."""
        return (1,)

    def prepare(self) -> CalibrationProblem:
        """The readings, with all parameters free."""
        return build_problem(self.session.unpack(), free=self.names, prior=True)

    def run(self, prepared: CalibrationProblem, task: int) -> Columns:
        """A row a reading or coordinate of the tool, and parameter."""
        problem, session = prepared, prepared.session
        _, jacobian = problem.linearise(problem.reference)
        seen: dict[tuple[str, str], Array] = {}
        setups, postures = list(session.setups), list(session.postures)
        o = problem.observations
        read = {postures[i] for i in o.posture}
        if session.robot.tcp is not None:
            names = problem.machine_selection.names
            tool = ToolSensitivity(session.robot, free=names)(problem.drives, names=postures)
            for posture, slopes in zip(
                postures, tool * problem.theta_scale[: len(names)], strict=True
            ):
                if posture in read:
                    seen.update(
                        {(posture, word): row for word, row in zip(TOOL, slopes, strict=True)}
                    )
        for i in range(o.size):
            key = postures[o.posture[i]], setups[o.setup[i]]
            seen.setdefault(key, jacobian[i, : problem.n_machine] * problem.noise[i])
        rows: dict[str, list[Any]] = {
            "posture": [],
            "reads": [],
            "parameter": [],
            "slope": [],
            "unit": [],
            "um_per_tolerance": [],
        }
        for (posture, reads), slopes in seen.items():
            parameters = problem.machine_selection.parameters
            for p, by_tolerance in zip(parameters, slopes, strict=True):
                rows["posture"].append(posture)
                rows["reads"].append(reads)
                rows["parameter"].append(p.name)
                rows["slope"].append(by_tolerance / MM / (p.tolerance * p.edge_factor))
                rows["unit"].append(f"mm/{p.edge_unit}")
                rows["um_per_tolerance"].append(by_tolerance / UM)
        return rows


def build_sensitivity_study(
    source: Robot | Session,
    free: Sequence[str] | None = None,
    *,
    points: Sequence[Sequence[float]] | None = None,
    displacements: Displacements | None = None,
) -> SensitivityStudy:
    """A study of what readings answer to errors.

    Args:
        source: A robot of the Orthoglide's kind, read by the paper's plan; or a session of any.
        free: Names or globs of the errors; by default all that change something.
        points: Where the tool stands instead, in every setup: coordinates that the drives control,
            shape (K, n_coordinates), [m].
        displacements: Of the paper's postures.

    Raises:
        ParameterError: If a name is unknown, or the robot cannot be read by the paper's plan.
        ClosureError: If a point cannot be reached.
    """
    session: Session
    if isinstance(source, Robot):
        session = build_paper_plan(
            source, displacements or Displacements(), Gauge(None, None, None)
        )
    else:
        session = source
    if points is not None:
        session = _at_points(session, np.atleast_2d(np.asarray(points, dtype=np.float64)))
    parameters = session.robot.parameters
    names = parameters.select(free if free is not None else parameters.patterns("full"))
    session = session.with_values(np.zeros(len(session.readings)))
    return SensitivityStudy(ShippedSession.of(session), tuple(names))


def _at_points(session: Session, points: Array) -> Session:
    """The same setups, each read with the tool at every point."""
    names = [f"point_{i + 1}" for i in range(len(points))]
    drives = nominal_assembly(session.robot).inverse(points, names=names)
    drives = drives - session.active_offsets
    postures = {
        n: Posture(n, "tcp_mm", p, d) for n, p, d in zip(names, points, drives, strict=True)
    }
    aligned_at = session.alignment_postures
    setups = {n: replace(s, aligned_at=aligned_at[n]) for n, s in session.setups.items()}
    alignment = {n: session.postures[n] for n in aligned_at.values()}
    readings = tuple(
        Reading(setup, posture, None, 1, 0.0, None)
        for setup in session.setups
        for posture in postures
    )
    return replace(session, setups=setups, postures={**postures, **alignment}, readings=readings)


@dataclass(frozen=True, slots=True, eq=False)
class SensitivitySummary:
    """What readings answer to errors, as a matrix."""

    rows: tuple[tuple[str, str], ...]
    """Posture, and what is read there."""
    parameters: tuple[str, ...]
    units: tuple[str, ...]
    """Of the slopes, by parameter."""
    slopes: Array
    """Shape (n_rows, n_parameters), [units]."""
    per_tolerance: Array
    """The same for an error of one tolerance, [m]."""


def summarise_sensitivity(study: SensitivityStudy, table: StudyTable) -> SensitivitySummary:
    """What readings answer to errors, as a matrix."""
    c, n = table.columns, len(study.names)
    pairs = list(zip(c["posture"], c["reads"], strict=True))[::n]
    shape = (len(pairs), n)
    return SensitivitySummary(
        rows=tuple((str(p), str(r)) for p, r in pairs),
        parameters=study.names,
        units=tuple(str(u) for u in c["unit"][:n]),
        slopes=np.array(c["slope"], dtype=np.float64).reshape(shape),
        per_tolerance=np.array(c["um_per_tolerance"], dtype=np.float64).reshape(shape) * UM,
    )
