"""Study of sensitivity: derivatives of readings and tool position with respect to each error.

They contain the factors of the paper (equation 6). In a maximum posture an offset of the moved
drive displaces the tool by this offset along the axis, and by tan α times the offset across it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from orthocal.arrays import Array
from orthocal.estimation.problem import CalibrationProblem, build_problem
from orthocal.kinematics.conditions import UseConditions
from orthocal.kinematics.sensitivity import ToolSensitivity
from orthocal.measurement.files.session_file import check_contacts
from orthocal.planning.equipment import place_tool
from orthocal.planning.first_plan import Displacements, build_paper_plan
from orthocal.robot.model import Robot
from orthocal.session.session import Conditions, Gauge, Reading, Session, describe_postures
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
        """Number of tables: 1."""
        return 1

    def prepare(self) -> CalibrationProblem:
        """Problem of the readings with all parameters free."""
        return build_problem(self.session, free=self.parameters, prior=True)

    def run(self, prepared: CalibrationProblem, task: int) -> Columns:
        """Table rows: one for each parameter and each reading or tool coordinate."""
        problem, session, observations = prepared, prepared.session, prepared.observations
        setups, postures = list(session.setups), list(session.postures)
        parameters = problem.machine_selection.parameters
        jacobian = problem.predict_and_jacobian(problem.active_theta)[1][:, : len(parameters)]
        approach_of = {
            i: r.approach for i, r in zip(observations.plus.tolist(), session.readings, strict=True)
        }
        places = [(postures[k], approach_of.get(i)) for i, k in enumerate(observations.posture)]
        changes_by_output = {} if session.robot.tcp is None else _tool_changes(problem, places)
        for i, (posture, approach) in enumerate(places):
            key = describe_postures(posture, None, approach), setups[observations.setup[i]]
            changes_by_output.setdefault(key, jacobian[i] * problem.noise_ratio[i])
        scales = np.array([p.prior_std * p.edge_factor for p in parameters])
        n, changes = len(changes_by_output), np.array(list(changes_by_output.values()))
        return {
            "posture": [posture for posture, _ in changes_by_output for _ in parameters],
            "output": [output for _, output in changes_by_output for _ in parameters],
            "parameter": [p.name for p in parameters] * n,
            "derivative": (changes / MM / scales).ravel().tolist(),
            "unit": [f"mm/{p.edge_unit}" for p in parameters] * n,
            "um_per_prior_std": (changes / UM).ravel().tolist(),
        }


def _tool_changes(
    problem: CalibrationProblem, places: Sequence[tuple[str, str | None]]
) -> dict[tuple[str, str], Array]:
    """Changes of tool coordinates by one prior standard deviation of each error, [m].

    Args:
        problem: The problem.
        places: Postures and approaches; the tool is at the reference temperature.

    Returns:
        Posture in words and coordinate, mapped to shape (n_machine,).
    """
    session, selection = problem.session, problem.machine_selection
    active = dict(zip(selection.names, problem.active_theta.tolist(), strict=False))
    result = {}
    for approach in dict.fromkeys(a for _, a in places):
        names = list(dict.fromkeys(n for n, a in places if a == approach))
        drives = np.array([session.postures[n].drives for n in names])
        conditions = UseConditions(approach=approach)
        tool = ToolSensitivity(
            session.robot,
            free=selection.names,
            values=active,
            conditions=conditions,
        )
        for name, changes in zip(names, tool(drives, names=names), strict=True):
            label = describe_postures(name, None, approach)
            for axis, change in zip(TOOL, changes * selection.prior_stds, strict=True):
                result[label, axis] = change
    return result


def build_sensitivity_study(
    source: Robot | Session,
    free: Sequence[str] | None = None,
    *,
    points: Sequence[Sequence[float]] | None = None,
    displacements: Displacements | None = None,
) -> SensitivityStudy:
    """Build a study of the derivatives of readings and tool position with respect to errors.

    Args:
        source: A robot of Orthoglide type, measured by the paper's plan; or a session of any robot.
        free: Names or globs of the errors; default: all that affect a reading or the tool.
        points: Tool positions at which every setup is read in place of its postures, with each of
            its approaches: commanded coordinates, shape (K, n_coordinates), [m].
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
    """Session in which every setup is read at every tool position, from each side of approach.

    Conditions are those of the first reading of the setup with the same approach.
    """
    names = [f"point_{i + 1}" for i in range(len(points))]
    postures_at_points = place_tool(session.robot, names, points)
    postures = {
        n: replace(p, drives=p.drives - session.active_offsets)
        for n, p in postures_at_points.items()
    }
    aligned_at = session.alignment_postures
    setups = {n: replace(s, aligned_at=aligned_at[n]) for n, s in session.setups.items()}
    alignment = {n: session.postures[n] for n in aligned_at.values()}
    conditions: dict[str, dict[str | None, Conditions | None]] = {name: {} for name in setups}
    for r in session.readings:
        conditions[r.setup].setdefault(r.approach, r.conditions)
    readings = tuple(
        Reading(setup, posture, conditions=stated)
        for setup, by_approach in conditions.items()
        for posture in postures
        for stated in (by_approach.values() or (None,))
    )
    postures = {**postures, **alignment}
    session_at_points = replace(session, setups=setups, postures=postures, readings=readings)
    check_contacts(session_at_points)
    return session_at_points


@dataclass(frozen=True, slots=True, eq=False)
class SensitivitySummary:
    """Matrix of the derivatives."""

    rows: tuple[tuple[str, str], ...]
    """Posture and output of each row: a setup or a tool coordinate."""
    parameters: tuple[str, ...]
    units: tuple[str, ...]
    """Units of the derivatives, for each parameter."""
    derivatives: Array
    """Derivatives, shape (n_rows, n_parameters), [units]."""
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
