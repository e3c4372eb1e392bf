"""Study of sensitivity: derivatives of readings and of the tool position by each error.

They contain the paper's factors: in a maximum posture, the offset of the drive that moved shifts
the tool by 1 along its axis and by tan α across it (equation 6).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from orthocal.arrays import Array
from orthocal.estimation.problem import CalibrationProblem, build_problem
from orthocal.kinematics.sensitivity import ToolSensitivity
from orthocal.measurement.files.session_file import check_contacts
from orthocal.observation.observations import drive_table
from orthocal.planning.equipment import place_tool
from orthocal.planning.first_plan import Displacements, build_paper_plan
from orthocal.robot.model import Robot
from orthocal.session.session import Gauge, Reading, Session
from orthocal.study.runner import StudyTable
from orthocal.study.study import Columns, Study
from orthocal.units import MM, UM

TOOL = ("tool x", "tool y", "tool z")


@dataclass(frozen=True, eq=False)
class SensitivityStudy(Study):
    """First derivatives of all readings of a plan, and of the tool, at the nominal machine."""

    kind: ClassVar[str] = "sensitivity"
    counted: ClassVar[str] = "tables"

    parameters: tuple[str, ...]
    """Names of the error parameters."""

    @property
    def count(self) -> int:
        """One table."""
        return 1

    def prepare(self) -> CalibrationProblem:
        """The readings, with all parameters free."""
        return build_problem(self.session, free=self.parameters, prior=True)

    def run(self, prepared: CalibrationProblem, task: int) -> Columns:
        """A row for each parameter of each reading and tool coordinate."""
        problem, session, o = prepared, prepared.session, prepared.observations
        setups, postures = list(session.setups), list(session.postures)
        parameters = problem.machine_selection.parameters
        jacobian = problem.predict_and_jacobian(problem.active_theta)[1][:, : len(parameters)]
        by_std: dict[tuple[str, str], Array] = {}
        read = {postures[i] for i in o.posture}
        if session.robot.tcp is not None:
            tool = ToolSensitivity(session.robot, free=problem.machine_selection.names)
            by_tool = tool(drive_table(session), names=postures)
            scaled = by_tool * problem.theta_scale[: len(parameters)]
            for posture, rows in zip(postures, scaled, strict=True):
                if posture in read:
                    by_std.update({(posture, axis): r for axis, r in zip(TOOL, rows, strict=True)})
        for i in range(o.size):
            key = postures[o.posture[i]], setups[o.setup[i]]
            by_std.setdefault(key, jacobian[i] * problem.noise_ratio[i])
        scales = np.array([p.prior_std * p.edge_factor for p in parameters])
        n = len(by_std)
        return {
            "posture": [posture for posture, _ in by_std for _ in parameters],
            "output": [output for _, output in by_std for _ in parameters],
            "parameter": [p.name for p in parameters] * n,
            "derivative": [v for row in by_std.values() for v in (row / MM / scales).tolist()],
            "unit": [f"mm/{p.edge_unit}" for p in parameters] * n,
            "um_per_prior_std": [v for row in by_std.values() for v in (row / UM).tolist()],
        }


def build_sensitivity_study(
    source: Robot | Session,
    free: Sequence[str] | None = None,
    *,
    points: Sequence[Sequence[float]] | None = None,
    displacements: Displacements | None = None,
) -> SensitivityStudy:
    """A study of the derivatives of readings and tool position by errors.

    Args:
        source: An Orthoglide-type robot, measured by the paper's plan; or a session of any robot.
        free: Names or globs of the errors; default: all that move a reading or the tool.
        points: Tool positions to read every setup at, instead of its postures: coordinates that
            the drives control, shape (K, n_coordinates), [m].
        displacements: Displacements of the paper's postures.

    Raises:
        ParameterError: If a name is unknown, or the robot cannot be measured by the paper's plan.
        ClosureError: If a point cannot be reached.
        SessionError: If a sensor has no contact at a point.
    """
    session: Session
    if isinstance(source, Robot):
        gauge = Gauge(None, None, None)
        session = build_paper_plan(source, displacements or Displacements(), gauge)
    else:
        session = source
    if points is not None:
        session = _at_points(session, np.atleast_2d(np.asarray(points, dtype=np.float64)))
    parameters = session.robot.parameters
    names = parameters.select(free if free is not None else parameters.patterns("full"))
    session = session.with_values(np.zeros(len(session.readings)))
    return SensitivityStudy(session, tuple(names))


def _at_points(session: Session, points: Array) -> Session:
    """The session with every setup read at every point of the tool."""
    names = [f"point_{i + 1}" for i in range(len(points))]
    placed = place_tool(session.robot, names, points)
    postures = {n: replace(p, drives=p.drives - session.active_offsets) for n, p in placed.items()}
    aligned_at = session.alignment_postures
    setups = {n: replace(s, aligned_at=aligned_at[n]) for n, s in session.setups.items()}
    alignment = {n: session.postures[n] for n in aligned_at.values()}
    readings = tuple(Reading(setup, posture) for setup in setups for posture in postures)
    postures = {**postures, **alignment}
    moved = replace(session, setups=setups, postures=postures, readings=readings)
    check_contacts(moved)
    return moved


@dataclass(frozen=True, slots=True, eq=False)
class SensitivitySummary:
    """Derivatives as a matrix."""

    rows: tuple[tuple[str, str], ...]
    """Posture, and the setup or tool coordinate."""
    parameters: tuple[str, ...]
    units: tuple[str, ...]
    """Units of the derivatives, by parameter."""
    derivatives: Array
    """Shape (n_rows, n_parameters), [units]."""
    per_prior_std: Array
    """Change by one prior standard deviation of each error, shape (n_rows, n_parameters), [m]."""


def summarise_sensitivity(study: SensitivityStudy, table: StudyTable) -> SensitivitySummary:
    """Summary of the table of a sensitivity study."""
    columns, n = table.columns, len(study.parameters)
    pairs = list(zip(columns["posture"], columns["output"], strict=True))[::n]

    def matrix(name: str) -> Array:
        return np.array(columns[name], dtype=np.float64).reshape(len(pairs), n)

    return SensitivitySummary(
        rows=tuple((str(posture), str(output)) for posture, output in pairs),
        parameters=study.parameters,
        units=tuple(str(u) for u in columns["unit"][:n]),
        derivatives=matrix("derivative"),
        per_prior_std=matrix("um_per_prior_std") * UM,
    )
