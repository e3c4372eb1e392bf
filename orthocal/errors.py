"""The errors orthocal raises: one tree, each with the exit code that the command line gives it."""

from __future__ import annotations

from orthocal.text import printable

LONGEST_MESSAGE = 2000
"""Characters of an error's message; the middle of a longer one is left out."""


class OrthocalError(Exception):
    """Base of all errors of orthocal.

    Its words can be shown anywhere: what comes from files and paths is escaped in them.

    Attributes:
        where: File and line or key that the error is about, or None.
        problem: What was found and what was expected.
    """

    exit_code = 2

    def __init__(self, problem: str, *, where: str | None = None) -> None:
        self.where = None if where is None else printable(where)
        self.problem = _shorten(printable(problem))
        super().__init__(self.problem if where is None else f"{self.where}: {self.problem}")

    def __reduce__(self) -> tuple[object, ...]:
        # as it is: what it was made of, another process cannot tell
        return _again, (type(self), self.args, self.__dict__)


def _again(
    kind: type[OrthocalError], told: tuple[object, ...], state: dict[str, object]
) -> OrthocalError:
    """An error as another process has raised it."""
    error = kind.__new__(kind, *told)
    error.__dict__.update(state)
    return error


def _shorten(problem: str) -> str:
    """A message that nobody has to scroll for, whatever a file holds."""
    half = LONGEST_MESSAGE // 2
    if len(problem) <= LONGEST_MESSAGE:
        return problem
    return f"{problem[:half]} … {problem[-half:]}"


class OutputError(OrthocalError):
    """A file or a stream cannot be written, though its name is one: no room, no right, closed."""

    exit_code = 1


class RobotError(OrthocalError):
    """A robot folder, its URDF or its YAML is not what it should be."""


class ParameterError(OrthocalError):
    """An error parameter, a pattern, a unit or a value given by name does not exist or fit."""


class SessionError(OrthocalError):
    """A session, its YAML or its CSV is not what it should be."""


class CalibrationFileError(OrthocalError):
    """A calibration file cannot be read, or does not belong to the robot it names."""


class ExportError(OrthocalError):
    """A calibration is not to be entered, or cannot be what a format needs."""

    exit_code = 3


class GcodeError(OrthocalError):
    """A program of a controller holds what cannot be corrected."""


class ClosureError(OrthocalError):
    """The loops of the robot cannot be closed in a posture.

    Attributes:
        posture: Name of the posture.
        reason: What is wrong there, to be read after the name of the posture.
        residual: Largest closure residual that remained, [m], or None for a singular posture.
    """

    def __init__(self, reason: str, *, posture: str, residual: float | None = None) -> None:
        self.posture = posture
        self.reason = _shorten(printable(reason))
        self.residual = residual
        super().__init__(f"posture '{posture}' {reason}")


class UnreachableError(OrthocalError):
    """A point or a set of joint coordinates has no solution in the closed forms of the paper."""


class NotIdentifiableError(OrthocalError):
    """Neither readings nor a prior fix some parameters.

    Attributes:
        parameters: Names of the parameters that nothing fixes.
    """

    def __init__(
        self, problem: str, *, parameters: tuple[str, ...], where: str | None = None
    ) -> None:
        self.parameters = parameters
        super().__init__(problem, where=where)


class SolverError(OrthocalError):
    """The solver did not converge: there is no result.

    Attributes:
        status: The solver's own word.
        iterations: Iterations it took.
    """

    exit_code = 1

    def __init__(self, problem: str, *, status: str, iterations: int) -> None:
        self.status = status
        self.iterations = iterations
        super().__init__(problem)
