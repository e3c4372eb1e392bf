"""The errors that orthocal raises, with the exit codes of the command line."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from orthocal.text import printable

LONGEST_MESSAGE = 2000
"""Largest number of characters of a message; the middle of longer ones is omitted."""

LONGEST_PLACE = LONGEST_MESSAGE // 2
"""Largest number of characters of the place in a message."""

_OMITTED = " … "


class OrthocalError(Exception):
    """Base of all errors of orthocal.

    Messages can be shown anywhere: characters from files and paths are escaped.

    Attributes:
        where: File and line or key of the error, or None.
        problem: What was found and what was expected.
        missing: Missing keys of a document; empty for other errors.
    """

    exit_code = 2

    def __init__(
        self, problem: str, *, where: str | None = None, missing: Sequence[str] = ()
    ) -> None:
        self.missing = tuple(missing)
        self.where = None if where is None else _shorten(printable(where), LONGEST_PLACE)
        place = "" if self.where is None else f"{self.where}: "
        self.problem = _shorten(printable(problem), LONGEST_MESSAGE - len(place))
        super().__init__(place + self.problem)

    def __reduce__(self) -> tuple[object, ...]:
        # by its attributes: another process does not know the arguments of __init__
        return _restore, (type(self), self.args, self.__dict__)


@contextmanager
def errors_at(where: str) -> Iterator[None]:
    """Add a place to the errors of the block that state none.

    Args:
        where: File and line, or file and key.
    """
    try:
        yield
    except OrthocalError as e:
        if e.where is None:
            OrthocalError.__init__(e, e.problem, where=where, missing=e.missing)
        raise


def _restore(
    kind: type[OrthocalError], arguments: tuple[object, ...], state: dict[str, object]
) -> OrthocalError:
    """An error that another process has raised."""
    error = kind.__new__(kind, *arguments)
    error.__dict__.update(state)
    return error


def _shorten(text: str, longest: int) -> str:
    """A text of limited length, without its middle if necessary."""
    half = (longest - len(_OMITTED)) // 2
    return text if len(text) <= longest else f"{text[:half]}{_OMITTED}{text[-half:]}"


class OutputError(OrthocalError):
    """A file or stream cannot be written: disk full, no permission, closed."""

    exit_code = 1


class RobotError(OrthocalError):
    """A robot directory, its URDF or its YAML is invalid."""


class ParameterError(OrthocalError):
    """An error parameter, a pattern, a unit or a value is unknown or invalid."""


class SessionError(OrthocalError):
    """A session, its YAML or its CSV is invalid."""


class UnreachablePostureError(SessionError):
    """The machine does not reach a posture of a session."""


class UnreachablePathError(SessionError):
    """The tool cannot follow its path to a posture of a setup.

    Attributes:
        setup: Name of the setup.
        posture: Name of the posture.
    """

    def __init__(self, message: str, *, setup: str, posture: str, where: str | None = None) -> None:
        super().__init__(message, where=where)
        self.setup, self.posture = setup, posture


class CalibrationFileError(OrthocalError):
    """A calibration file is invalid, or does not belong to the robot that it names."""


class ExportError(OrthocalError):
    """A calibration should not be entered, or cannot be expressed in a format."""

    exit_code = 3


class GcodeError(OrthocalError):
    """A G-code program is invalid, or contains commands that cannot be corrected."""


class ClosureError(OrthocalError):
    """The loops of the robot cannot be closed in a posture.

    Attributes:
        posture: Name of the posture.
        reason: Predicate of the message, whose subject is the posture.
        residual: Largest closure residual, rotations times characteristic length, [m]; None for
            another cause, such as a singular posture or the travel of a drive.
    """

    def __init__(self, reason: str, *, posture: str, residual: float | None = None) -> None:
        self.posture = posture
        self.reason = _shorten(printable(reason), LONGEST_MESSAGE)
        self.residual = residual
        super().__init__(f"posture '{posture}' {reason}")


class UnreachableError(OrthocalError):
    """The paper's closed forms have no solution: a displacement or a point is beyond a leg."""


class NotIdentifiableError(OrthocalError):
    """Neither the readings nor a prior determine some parameters.

    Attributes:
        parameters: Names of these parameters.
    """

    def __init__(
        self, problem: str, *, parameters: tuple[str, ...], where: str | None = None
    ) -> None:
        self.parameters = parameters
        super().__init__(problem, where=where)


class SolverError(OrthocalError):
    """The solver did not converge; there is no result.

    Attributes:
        status: Status that the solver reports.
        iterations: Number of iterations.
    """

    exit_code = 1

    def __init__(self, problem: str, *, status: str, iterations: int) -> None:
        self.status = status
        self.iterations = iterations
        super().__init__(problem)
