"""The YAML beside a robot's URDF, validated.

The keys at the top are those of the Gepetto "extended URDF"; all else stands under `orthocal`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, model_validator

from orthocal.errors import RobotError
from orthocal.io.documents import Number, PositiveNumber, read_yaml, validate
from orthocal.robot.joint_types import JOINT_TYPES
from orthocal.text import composed

Row = Literal["x", "y", "z", "rx", "ry", "rz"]
Coordinate = Literal["x", "y", "z"]
Name = Annotated[str, Field(min_length=1, max_length=200), AfterValidator(composed)]


def _in_small_letters(value: object) -> object:
    return value.lower() if isinstance(value, str) else value


ClosureKind = Annotated[Literal["3d", "6d"], BeforeValidator(_in_small_letters)]
"""Gepetto's robots write it in capitals, too."""


THICKEST_ROD_MM = 500.0
"""No rod that a gauge touches is thicker: it is a wrong unit."""

LARGEST_WORKSPACE_MM = 1e4

MOST_PARTS = 100
"""Legs, closures and named sums of a robot, of each."""


class _Keys(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, defer_build=True)


class ClosureKeys(_Keys):
    """Keys that orthocal adds to one pair of `closed_loop`."""

    rows: list[Row] | None = None
    """Rows that count, in the axes of the pair's first frame; all by default."""


class JointKeys(_Keys):
    """A controller's joint, where it counts otherwise than the drive."""

    counts: Literal["up", "down"] = "up"
    """Whether the joint grows with the drive's coordinate, or against it."""
    at_zero_mm: Number | None = None
    """What the joint shows in the mechanical zero, of a prismatic drive; the drive's own
    coordinate where it is not said."""
    at_zero_deg: Number | None = None
    """The same for a revolute drive."""


class DriveKeys(_Keys):
    """Keys that orthocal adds to one motor."""

    zero_mm: Number | None = None
    """Commanded coordinate of the mechanical zero, for a prismatic drive."""
    zero_deg: Number | None = None
    """The same for a revolute drive."""
    joint: JointKeys | None = None
    """How the controller counts; as the drive where it is not said."""


class RodKeys(_Keys):
    """A round rod of a leg."""

    root: Name
    """Frame on its axis, at the drive's end."""
    tip: Name
    """Frame on its axis, at the platform's end."""
    radius_mm: Annotated[PositiveNumber, Field(le=THICKEST_ROD_MM)]


class LegKeys(_Keys):
    """The line that a gauge touches."""

    root: Name
    """Frame at the drive's end of the leg."""
    tip: Name
    """Frame at the platform's end of the leg."""
    rods: dict[Name, RodKeys] = {}
    """Round rods of the leg that a gauge may touch, by name."""


class TcpKeys(_Keys):
    """The tool centre point."""

    frame: Name
    """Its frame."""
    coordinates: Annotated[list[Coordinate], Field(min_length=1, max_length=3)] = ["x", "y", "z"]
    """World coordinates that the drives control; as many as drives where postures are
    commanded by the tool."""


def _require_ascending(limits: list[float]) -> list[float]:
    low, high = limits
    if not -LARGEST_WORKSPACE_MM <= low < high <= LARGEST_WORKSPACE_MM:
        raise ValueError(
            f"found [{low:g}, {high:g}]; expected [least, largest], in mm, within "
            f"±{LARGEST_WORKSPACE_MM:g}"
        )
    return limits


WorkspaceBox = Annotated[
    list[
        Annotated[
            list[Number], Field(min_length=2, max_length=2), AfterValidator(_require_ascending)
        ]
    ],
    Field(min_length=1, max_length=3),
]
"""Limits of each coordinate of the tool, relative to the mechanical zero, [mm]."""


class WorkspaceKeys(_Keys):
    """Workspace: the region over which errors at the tool are reported."""

    box_mm: WorkspaceBox


class OrthocalKeys(_Keys):
    """Everything that is not in Gepetto's keys."""

    closures: dict[Name, ClosureKeys] | None = None
    drives: dict[Name, DriveKeys] = {}
    passive_start: dict[Name, Number] = {}
    """Passive joint with `_mm` or `_deg` suffix to the value from which the loops are first
    closed; 0 where absent."""
    legs: Annotated[dict[Name, LegKeys], Field(max_length=MOST_PARTS)] = {}
    tcp: TcpKeys | None = None
    workspace: WorkspaceKeys | None = None
    parameters: Annotated[
        dict[Name, Annotated[list[Name], Field(min_length=1)]], Field(max_length=MOST_PARTS)
    ] = {}
    """Named sums of elementary errors; a leading '-' subtracts."""
    tolerances: dict[str, Any] = {}
    """Tolerances of the errors that every machine has, read by `orthocal.effects`."""
    effects: Annotated[dict[Name, dict[str, Any]], Field(max_length=MOST_PARTS)] = {}
    """Further effects by name, with keys that each reads itself."""
    models: dict[Name, Annotated[list[Name], Field(min_length=1)] | Literal["complete"]] = {}
    """Patterns of names; or every error that changes something."""


class RobotKeys(_Keys):
    """A whole robot YAML."""

    closed_loop: Annotated[
        list[Annotated[list[Name], Field(min_length=2, max_length=2)]],
        Field(max_length=MOST_PARTS),
    ]
    """Pairs of frames that coincide."""
    type: list[ClosureKind]
    """Whether a pair shares its origin only, or its axes too."""
    name_mot: Annotated[list[Name], Field(min_length=1)]
    """The actuated joints."""
    joint_name: list[Name] = []
    """Joints that are of another type than the URDF says."""
    joint_type: list[str] = []
    """Of each of them: SPHERICAL, UJOINT_XY (about x, then y; other axes alike) or FIXED."""
    orthocal: OrthocalKeys = OrthocalKeys()

    @model_validator(mode="after")
    def _lengths_agree(self) -> RobotKeys:
        pairs = len(self.closed_loop)
        if len(self.type) != pairs:
            raise ValueError(f"type has {len(self.type)} entries; closed_loop has {pairs}")
        closures = self.orthocal.closures
        if closures is not None and len(closures) != pairs:
            raise ValueError(
                f"orthocal.closures has {len(closures)} entries; closed_loop has {pairs}, "
                "and each needs one, in the same order"
            )
        if len(set(self.name_mot)) != len(self.name_mot):
            raise ValueError("name_mot names a motor twice")
        self._check_joint_types()
        for motor in self.orthocal.drives:
            if motor not in self.name_mot:
                raise ValueError(
                    f"orthocal.drives.{motor} is not in name_mot; motors: "
                    f"{', '.join(self.name_mot)}"
                )
        for name, kind in zip(closures or {}, self.type, strict=False):
            rows = (closures or {})[name].rows
            if rows is None:
                continue
            if not rows or len(set(rows)) != len(rows):
                raise ValueError(f"orthocal.closures.{name}.rows is empty or names a row twice")
            if kind == "3d" and any(r.startswith("r") for r in rows):
                raise ValueError(
                    f"orthocal.closures.{name}.rows holds a rotation; a 3d closure has x, y, z"
                )
        return self

    def _check_joint_types(self) -> None:
        if len(self.joint_name) != len(self.joint_type):
            raise ValueError(
                f"joint_type has {len(self.joint_type)} entries; joint_name has "
                f"{len(self.joint_name)}"
            )
        if len(set(self.joint_name)) != len(self.joint_name):
            raise ValueError("joint_name names a joint twice")
        for name, declared in zip(self.joint_name, self.joint_type, strict=True):
            if declared not in JOINT_TYPES:
                raise ValueError(
                    f"joint_type of '{name}': found '{declared}'; expected {', '.join(JOINT_TYPES)}"
                )
            if name in self.name_mot:
                raise ValueError(f"joint_name: '{name}' is a motor, which stays what the URDF says")

    @property
    def joint_types(self) -> dict[str, str]:
        """Joint to the type that it is declared to be of."""
        return dict(zip(self.joint_name, self.joint_type, strict=True))


def load_description(path: Path, *, content: bytes | None = None) -> RobotKeys:
    """Read and validate a robot's YAML.

    Args:
        path: The file.
        content: What it holds, where it was read already.

    Raises:
        RobotError: Naming file and key.
    """
    data = read_yaml(path, error=RobotError, content=content)
    return validate(RobotKeys, data, where=str(path), error=RobotError)
