"""Batches of machines, as the studies use them: tool positions and estimates."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from orthocal.errors import ClosureError, SolverError
from orthocal.estimation.problem import CalibrationProblem
from orthocal.estimation.solvers.batch import BatchProgram
from orthocal.kinematics.loop_closure import Failures, LoopClosure
from orthocal.robot.model import Robot

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]


def tool_positions(
    robot: Robot, errors: Array, drives: Array, passive: Array
) -> tuple[Array, Flags]:
    """Tool positions of many machines, shape (n_postures, 3, n_sets), [m].

    Args:
        robot: The nominal robot.
        errors: All elementary errors of each machine, shape (n_sets, n_errors), [SI].
        drives: Commanded drive coordinates, shape (n_postures, n_drives), [m, rad].
        passive: Passive coordinates of the nominal robot, shape (n_postures, n_passive).

    Returns:
        The positions, and whether the loops of each machine close, shape (n_sets,).
    """
    closure, failures = LoopClosure(robot), Failures()
    q = closure.close(drives, errors=errors, start=passive, failures=failures)
    closed = np.ones(len(errors), dtype=np.bool_)
    closed[[i // len(drives) for i in failures]] = False
    return np.moveaxis(closure.tcp(drives, q, errors=errors), 0, -1), closed


def estimate_batch(
    program: BatchProgram, problem: CalibrationProblem, values: Array, sigma: float
) -> tuple[Array, Flags]:
    """Estimates of many machines, and whether each calibration converges.

    Args:
        program: Solver, with the data that all machines share.
        problem: Its problem.
        values: Readings, shape (n_sets, n_entries), [m of the first gauge].
        sigma: Standard deviation of one reading, [m].

    Returns:
        Free parameters, shape (n_sets, n_free), [SI], NaN where the calibration fails.
    """
    converged = np.ones(len(values), dtype=np.bool_)
    try:
        return program.solve(values, sigma=sigma).theta, converged
    except (SolverError, ClosureError):  # one by one, to find the machines that fail
        theta = np.full((len(values), problem.n_free), np.nan)
        for i in range(len(values)):
            try:
                theta[i] = BatchProgram(problem).solve(values[i : i + 1], sigma=sigma).theta[0]
            except (SolverError, ClosureError):
                converged[i] = False
        return theta, converged


def columns_in_edge_units(
    prefix: str, problem: CalibrationProblem, values: Array
) -> dict[str, Sequence[float]]:
    """Table columns of machine parameters, named with the unit that users read.

    Args:
        prefix: Start of each column's name.
        problem: The problem.
        values: Shape (n_sets, n_machine), [SI].
    """
    return {
        f"{prefix}{p.name}_{p.edge_unit}": list(values[:, i] * p.edge_factor)
        for i, p in enumerate(problem.machine_selection.parameters)
    }
