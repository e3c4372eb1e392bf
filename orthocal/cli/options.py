"""Program object, options that several commands share, and readers of their values."""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar, cast, get_args, get_type_hints

import typer
from typer import Argument, Option
from typer.core import TyperCommand, TyperGroup

import orthocal
from orthocal.errors import ParameterError, errors_at
from orthocal.text import shorten
from orthocal.units import MM

if TYPE_CHECKING:
    from orthocal.arrays import Array
    from orthocal.effects.compensation import Compensation
    from orthocal.kinematics.workspace import Workspace

Command = TypeVar("Command", bound=Callable[..., None])

LARGEST_MM = 1e4
"""Largest coordinate of a box, displacement and size of errors, [mm]."""

LONGEST_LINE = 100
"""Number of characters of a line of help; longer lines are wrapped, not cut off."""


_EXPECTED = {
    "int_parsing": "an integer",
    "float_parsing": "a number",
    "greater_than_equal": "at least {ge}",
    "less_than_equal": "at most {le}",
}
"""Kind of an error about the value of an option, mapped to the expected value."""


class PanelGroup(TyperGroup):
    """Group whose help lists the commands panel by panel, and whose errors show what was found."""

    def invoke(self, ctx: Any) -> Any:  # noqa: ANN401 - Click's types
        """Run a command; an error about an option states value and expectation."""
        try:
            return super().invoke(ctx)
        except typer.BadParameter as e:
            from pydantic import ValidationError

            errors = e.__cause__.errors() if isinstance(e.__cause__, ValidationError) else []
            for error in errors[:1]:
                expected = _EXPECTED.get(error["type"], error["msg"]).format(**error.get("ctx", {}))
                choices = expected.partition(" is not one of ")[2]
                expected = f"one of {choices}" if choices else expected
                e.message = f"found '{shorten(str(error['input']))}'; expected {expected}"
            raise

    def format_commands(self, ctx: Any, formatter: Any) -> None:  # noqa: ANN401 - Click's types
        """Write one section for each panel."""
        panels: dict[str, list[tuple[str, str]]] = {}
        names = self.list_commands(ctx)
        width = max(map(len, names))
        for name in names:
            command: Any = self.get_command(ctx, name)
            line = command.get_short_help_str(LONGEST_LINE)
            panel = command.rich_help_panel or "Commands"
            panels.setdefault(panel, []).append((name.ljust(width), line))
        for panel, lines in panels.items():
            with formatter.section(panel):
                formatter.write_dl(lines)


class CommandOnce(TyperCommand):
    """Command that refuses an option that is stated twice and has one value."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:  # noqa: ANN401 - Click's types
        """Read the options; the last of several values would replace the others."""
        order: list[Any] = self.make_parser(ctx).parse_args(args=list(args))[2]
        remaining = super().parse_args(ctx, args)
        for option in order:
            if order.count(option) > 1 and not option.multiple:
                raise typer.BadParameter("is stated twice; expected once", ctx=ctx, param=option)
        return remaining


def make_group(description: str, **settings: Any) -> typer.Typer:  # noqa: ANN401 - Typer's settings
    """Make a group of commands."""
    return typer.Typer(
        cls=PanelGroup,
        no_args_is_help=True,
        rich_markup_mode=None,  # its tables of options cut off long words
        help=description,
        **settings,
    )


app = make_group(
    "Calibrate Orthoglide-type parallel robots from dial-indicator readings.",
    add_completion=False,
    pretty_exceptions_enable=False,
)

_ENTRY = re.compile(r"^ {4}(\w+)(?: \((.+?)\))?: (.+(?:\n {8}.+)*)", re.MULTILINE)
"""Entry of a docstring: name, metavar and help of a parameter."""


def command(group: typer.Typer = app, *, name: str | None = None) -> Callable[[Command], Command]:
    """Decorator of commands, whose arguments and options are described in their docstrings.

    An entry under Args is `name (METAVAR): help`. A parameter without a default is an argument,
    and every other parameter is an option; `with_` is --with. An `Option` in its annotation states
    limits and other names. The fields of a parameter that is a dataclass are options, described in
    the docstring of the dataclass in the same way. `SharedOptions` describes those without an
    entry.

    Args:
        group: Group of the command.
        name: Name of the command; default: that of the function.
    """

    def register(function: Command) -> Command:
        hints: dict[str, Any] = get_type_hints(function)
        records = {name: kind for name, kind in hints.items() if is_dataclass(kind)}

        def call(**values: Any) -> None:  # noqa: ANN401 - values of the options
            for name, kind in records.items():
                values[name] = cast("type", kind)(
                    **{f.name: values.pop(f.name) for f in fields(kind)}
                )
            function(**values)

        parameters = _list_parameters(function)
        call.__name__ = function.__name__
        call.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined] # of callables
        call.__annotations__ = {p.name: p.annotation for p in parameters}
        text, _, _ = (inspect.getdoc(function) or "").partition("\n\nArgs:\n")
        group.command(name, cls=CommandOnce, help=text)(call)
        return function

    return register


def _list_parameters(source: Callable[..., Any]) -> list[inspect.Parameter]:
    """Parameters of a command or fields of a record, annotated with their descriptions."""
    described = _read_entries(SharedOptions) | _read_entries(source)
    hints: dict[str, Any] = get_type_hints(source, include_extras=True)
    parameters = []
    for parameter in inspect.signature(source).parameters.values():
        hint = hints[parameter.name]
        if is_dataclass(hint):
            parameters += _list_parameters(cast("type", hint))
            continue
        hint = _describe(parameter, hint, *described.get(parameter.name, ("", "")))
        parameters.append(parameter.replace(annotation=hint, kind=inspect.Parameter.KEYWORD_ONLY))
    return parameters


def _read_entries(source: Callable[..., Any]) -> dict[str, tuple[str, str]]:
    """Metavar and help of the parameters that a docstring describes, by name."""
    entries = (inspect.getdoc(source) or "").partition("\n\nArgs:\n")[2]
    return {name: (metavar, words) for name, metavar, words in _ENTRY.findall(entries)}


def _describe(parameter: inspect.Parameter, hint: Any, metavar: str, words: str) -> Any:  # noqa: ANN401 - annotations
    """Annotation of a parameter with its metavar and help."""
    if hasattr(hint, "__metadata__"):
        kind, info = get_args(hint)
        info = copy(info)
    elif parameter.default is inspect.Parameter.empty:
        kind, info = hint, Argument()
    else:  # a stated name: a flag has no negative form
        kind, info = hint, Option(f"--{parameter.name.strip('_').replace('_', '-')}")
    if words:
        info.metavar, info.help = metavar or None, " ".join(words.split())
    return Annotated[kind, info]


OutDirectory = Annotated[Path, Option()]
Positive = Annotated[int | None, Option(min=1)]
Seed = Annotated[int, Option(min=0)]
Workers = Annotated[int | None, Option(min=1, max=1024)]


class SharedOptions:
    """Arguments and options that several commands share.

    Args:
        sessions (SESSION...): session.yaml, or the directory that contains it; several are
            calibrated together.
        subject (ROBOT|SESSION): An Orthoglide-type robot, measured by the paper's plan; or a
            session.
        plan (PLAN): session.yaml of a plan or a session, or its directory.
        calibration (CALIBRATION): calibration.json, or the directory that contains it.
        model (MODEL): Errors to identify: full (the complete machine), offsets, lengths or another
            model of the robot; default: that of the session, else full.
        free (PATTERNS): Errors to identify, by name or pattern; * stands for any text. With --model
            they are additional; '!' excludes: --model full --free '!*_fork.*'.
        tolerance (PATTERN=VALUE): Tolerance (± limit) instead of the robot's, such as
            '*.offset_mm=4'; * stands for any text.
        effects (EFFECTS): Effects to identify, such as backlash,thermal, or none; default: those
            that the session states, else those of the robot.
        temperature (FIRST:LAST): Temperature at the first and at the last reading, °C, such as
            20:28.
        error (NAME=VALUE): Error of the machine, such as x_slide.offset_mm=1.2.
        errors (FILE): YAML file with errors of the machine, such as a truth.yaml.
        gauge (FILE): dial.yaml with range, resolution and tip of the gauge; default tip: ball of
            3 mm diameter; default gauge: ±5 mm, 10 µm, this ball.
        with_ (FILE): A sensor at the tool that you have, such as a ball bar or a square;
            repeatable.
        hours (HOURS): Time available for measuring; default: what 6 setups take.
        workspace_mm (HALF|LOW:HIGH,...): Workspace around the mechanical zero, mm: half the side of
            a cube, or a range for each coordinate; default: that of the robot, else the largest
            cube that the machine reaches, at most ±60 mm.
        half_side_mm (MM): Half the side of a cube around the mechanical zero; default: the
            workspace.
        tool (X,Y,Z): Tip of the tool in the frame of the tool centre point, mm; default: 0,0,0.
        payload (KG): Mass on the tool, kg; default: none.
        seed (N): Seed of the random numbers.
        workers (N): Number of processes; default: all cores.
        leg_mm (MM): Leg length of an Orthoglide of other dimensions.
        dask (ADDRESS): Run on a Dask cluster; address of its scheduler.
        out (DIRECTORY): Directory for the results; created if necessary.
        json: Print the result as JSON.
        details: Print the complete result, not the short answer.
        all_: List every reading, parameter and group.
        force: Overwrite existing files.
        anyway: Continue against the verdict of the calibration.
    """


def _describe_excluded(
    workspace: Workspace, robot: orthocal.Robot, axes: Sequence[tuple[float, float]], ini: Path
) -> str:
    """Note about axes whose soft limits exclude a part of the workspace; "" without any.

    Args:
        workspace: The workspace.
        robot: The robot.
        axes: MIN_LIMIT and MAX_LIMIT of X, Y and Z in tool coordinates, [m].
        ini: The INI file.
    """
    from orthocal.assessment.wording import joined
    from orthocal.output.sheet.soft_limits import ROUNDING
    from orthocal.robot.model import require_tcp

    excluded = [
        f"[AXIS_{'XYZ'[c]}]"
        for c, points in zip(require_tcp(robot).coordinates, workspace.points.T, strict=True)
        if points.min() < axes[c][0] - ROUNDING or points.max() > axes[c][1] + ROUNDING
    ]
    if not excluded:
        return ""
    return (
        f"{ini}: the soft limits of {joined(excluded)} exclude a part of the workspace. The "
        "expected tool error counts all of it, unless --workspace-mm states a smaller one."
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class ControllerOptions:
    """Options about what the controller corrects during the measurement.

    Args:
        backlash (B[,B,...]): Backlash that the controller compensates, mm or degrees: one number
            for all drives or one for each; 0 for none.
        ini (FILE): INI file of LinuxCNC with BACKLASH and COMP_FILE, instead of --backlash, and
            HOME_OFFSET. Plans keep its soft limits; motions beyond them are named.
    """

    backlash: str | None = None
    ini: Path | None = None

    def limit(
        self,
        equipment: orthocal.Equipment,
        robot: orthocal.Robot,
        origin: tuple[float, float, float] = (0.0, 0.0, 0.0),
        workspace: Workspace | None = None,
    ) -> orthocal.Equipment:
        """Equipment whose postures are within the soft limits of the INI file.

        A note names axes whose limits exclude a part of the workspace.

        Args:
            equipment: The equipment.
            robot: The robot.
            origin: Displayed tool coordinates in the origin of the world, [m].
            workspace: The workspace; by default that of the robot.

        Raises:
            ParameterError: If the file does not fit the robot, or an axis leaves no room.
        """
        import numpy as np

        from orthocal.cli.printing import put_note
        from orthocal.kinematics.reachable_box import find_workspace
        from orthocal.measurement.files.linuxcnc_ini import read_controller_joints

        if self.ini is None:
            return equipment
        joints = read_controller_joints(self.ini, robot)
        axes = [
            (low - shift, high - shift)
            for (low, high), shift in zip(joints.axis_limits, origin, strict=True)
        ]
        limited = equipment.within_limits(robot, joints.limits, axes)
        if robot.commands_tool and np.isfinite(axes).any():
            put_note(_describe_excluded(workspace or find_workspace(robot), robot, axes, self.ini))
        return limited

    def read(self, robot: orthocal.Robot) -> Compensation | None:
        """Compensation of the controller; None without an option.

        Raises:
            ParameterError: If an option is malformed, or does not fit the robot.
            SessionError: If a COMP_FILE is wrong.
        """
        from orthocal.effects.compensation import JointTrim
        from orthocal.measurement.files.linuxcnc_ini import read_controller_joints
        from orthocal.measurement.files.session_keys import LARGEST_TRIM

        where, drives = "--backlash", robot.drives
        if self.ini is not None:
            if self.backlash is not None:
                raise ParameterError("found with --ini; expected one", where=where)
            return read_controller_joints(self.ini, robot).compensation
        if self.backlash is None:
            return None
        values = read_numbers(self.backlash, where)
        values = values * len(drives) if len(values) == 1 else values
        if len(values) != len(drives) or not all(0.0 <= v <= LARGEST_TRIM for v in values):
            names = ", ".join(d.name for d in drives)
            raise ParameterError(
                f"found '{self.backlash}'; expected one number of 0 to {LARGEST_TRIM:g} for all "
                f"drives, or one for each of {names}",
                where=where,
            )
        return tuple(JointTrim(v * d.joint_size) for v, d in zip(values, drives, strict=True))


@dataclass(frozen=True, slots=True, kw_only=True)
class UseOptions:
    """Options about the conditions of use.

    Args:
        temperature (C): Temperature of the machine, °C; default: the robot's reference temperature
            (20 °C).
        approach (LETTERS): Sides from which the drives come, a letter for each: p if its coordinate
            grew in the last motion, n if it fell, u if unknown, such as pnp; default: the middle of
            both sides.
    """

    approach: str | None = None
    temperature: float | None = None
    payload: float | None = None

    def read(self, robot: orthocal.Robot) -> orthocal.UseConditions:
        """Conditions of use.

        Raises:
            ParameterError: If a condition is out of range, or no effect of the machine depends on
                it.
        """
        conditions = orthocal.UseConditions(self.approach, self.temperature, self.payload)
        conditions.require_valid(robot, prefix="--")
        return conditions


def read_pairs(texts: Sequence[str] | None, option: str, form: str) -> dict[str, str]:
    """Values by name of a repeated option NAME=VALUE.

    Args:
        texts: Values of the option.
        option: Name of the option, for messages.
        form: Expected form, for messages.

    Raises:
        ParameterError: If a text has another form, or a name is stated twice.
    """
    pairs: dict[str, str] = {}
    for text in texts or []:
        name, _, value = (part.strip() for part in text.partition("="))
        if not (name and value):
            raise ParameterError(f"found '{shorten(text)}'; expected {form}", where=option)
        if name in pairs:
            raise ParameterError(f"states {shorten(name)} twice", where=option)
        pairs[name] = value
    return pairs


def split_globs(texts: Sequence[str] | None) -> list[str]:
    """Globs of repeated options, each with one or several globs separated by commas."""
    return [glob.strip() for text in texts or [] for glob in text.split(",") if glob.strip()]


def split_effects(text: str | None) -> list[str] | None:
    """Names of the option `--effects`; None if the option is absent."""
    if text is None:
        return None
    names = split_globs([text])
    return [] if names == ["none"] else names


def read_temperatures(text: str | None) -> tuple[float, float] | None:
    """Temperatures of the first and the last reading from the option `--temperature`, [°C].

    Raises:
        ParameterError: If the text is neither one temperature nor two.
    """
    from orthocal.robot.description import HIGHEST_C, LOWEST_C

    if text is None:
        return None
    where = "--temperature"
    first, colon, last = text.partition(":")
    temperatures = read_number(first, where), read_number(last if colon else first, where)
    for value in temperatures:
        require_between(value, LOWEST_C, HIGHEST_C, where)
    return temperatures


def load_robot_or_session(subject: str) -> tuple[orthocal.Session | None, orthocal.Robot]:
    """Session, or None for a robot, and the robot.

    Raises:
        OrthocalError: If the subject is neither a session nor a robot, or does not load.
    """
    from orthocal.output.text.subject import load_subject

    source = load_subject(subject)
    if isinstance(source, orthocal.Session):
        return source, source.robot
    if isinstance(source, orthocal.Robot):
        return None, source
    raise ParameterError("is a calibration; expected a robot or a session", where=subject)


def read_tolerances(texts: Sequence[str] | None, robot: orthocal.Robot) -> dict[str, float]:
    """Tolerances of `--tolerance`, as in `Choice`.

    Raises:
        ParameterError: If a text is not GLOB=VALUE, or its glob selects no error of the robot.
    """
    from orthocal.estimation import selection

    return selection.read_tolerances(texts or [], robot.parameters, where="--tolerance")


def state_tolerances(session: orthocal.Session, texts: Sequence[str] | None) -> orthocal.Session:
    """Session in which tolerances of `--tolerance` replace those of the robot.

    Raises:
        ParameterError: If a text is malformed or selects no error, or a tolerance is implausible.
    """
    with errors_at("--tolerance"):
        return session.with_tolerances(read_tolerances(texts, session.robot))


def read_number(text: str, option: str, name: str = "it") -> float:
    """Number of an option.

    Raises:
        ParameterError: If the value is not a finite number.
    """
    from orthocal.io.documents import parse_number

    return parse_number(text.strip(), where=option, name=name, error=ParameterError)


def read_numbers(text: str, option: str, names: Sequence[str] | None = None) -> tuple[float, ...]:
    """Numbers of an option, separated by commas.

    Args:
        text: Value of the option.
        option: Name of the option, for messages.
        names: Names of the numbers; None to accept any count.

    Raises:
        ParameterError: If the count of values differs, or a value is not finite.
    """
    parts = text.split(",")
    names = names or ["part"] * len(parts)
    if len(parts) != len(names):
        raise ParameterError(
            f"found '{text}'; expected {len(names)} numbers, {','.join(names)}", where=option
        )
    return tuple(read_number(p, option, name) for p, name in zip(parts, names, strict=True))


def read_vector(text: str, option: str) -> tuple[float, float, float]:
    """Coordinates of an option X,Y,Z in mm, converted to [m].

    Raises:
        ParameterError: If the text is not three finite numbers.
    """
    x, y, z = read_numbers(text, option, "XYZ")
    return (x * MM, y * MM, z * MM)


def read_box(text: str, letters: str, *, where: str) -> Array:
    """Box of an option, shape (n, 2), [m].

    Args:
        text: Half the side of a cube, such as 80, or LOW:HIGH for each coordinate or all of them,
            separated by commas, in mm.
        letters: Names of the coordinates.
        where: The option, for messages.

    Raises:
        ParameterError: If the text is not a box.
    """
    import numpy as np

    rows = []
    for part in text.split(","):
        low, colon, high = part.partition(":")
        end = read_number(high if colon else low, where)
        start = read_number(low, where) if colon else -end
        if not -LARGEST_MM <= start < end <= LARGEST_MM or (not colon and "," in text):
            raise ParameterError(
                f"found '{part}'; expected half the side of a cube, such as 80, or LOW:HIGH of "
                f"{','.join(letters)}, such as {','.join(['-80:80'] * len(letters))}, in mm",
                where=where,
            )
        rows.append((start, end))
    if len(rows) not in (1, len(letters)):
        raise ParameterError(
            f"has {len(rows)} ranges; expected one for all, or one for each of {','.join(letters)}",
            where=where,
        )
    return np.array(rows * (len(letters) if len(rows) == 1 else 1)) * MM


def read_workspace(text: str, robot: orthocal.Robot, *, where: str = "--workspace-mm") -> Array:
    """Workspace of an option, which the nominal machine must reach, shape (n, 2), [m].

    Raises:
        ParameterError: If the text is not a box, or the machine does not reach it.
    """
    from orthocal.kinematics.reachable_box import describe_unreachable_box
    from orthocal.kinematics.workspace import coordinate_letters

    box = read_box(text, coordinate_letters(robot), where=where)
    problem = describe_unreachable_box(robot, box)
    if problem:
        raise ParameterError(problem, where=where)
    return box


def require_between(value: float, low: float, high: float, option: str) -> None:
    """Refuse a value of an option outside an open range.

    Raises:
        ParameterError: If the value is out of range.
    """
    if not low < value < high:
        raise ParameterError(
            f"found {value:g}; expected a number between {low:g} and {high:g}", where=option
        )
