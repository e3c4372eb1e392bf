"""Choice of the solver."""

from __future__ import annotations

from orthocal.estimation.options import SolverOptions
from orthocal.estimation.problem import CalibrationProblem
from orthocal.estimation.solvers.program import Program


def build_program(problem: CalibrationProblem, options: SolverOptions | None = None) -> Program:
    """A problem prepared for the chosen solver; Ipopt by default."""
    chosen = options or SolverOptions()
    if chosen.solver == "variable-projection":
        from orthocal.estimation.solvers.variable_projection import VariableProjection

        return VariableProjection(problem, options=chosen)
    if chosen.solver == "linearised":
        from orthocal.estimation.solvers.linearised import LinearisedProgram

        return LinearisedProgram(problem, options=chosen)
    from orthocal.estimation.solvers.ipopt import NonlinearProgram

    return NonlinearProgram(problem, options=chosen)
