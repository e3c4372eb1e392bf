"""Keys of a robot's YAML, and their validation.

The top-level keys are those of the Gepetto "extended URDF"; all others are below `orthocal`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BeforeValidator, Field, model_validator

from orthocal.errors import RobotError
from orthocal.io.documents import Keys, Number, PositiveNumber, read_yaml, validate
from orthocal.robot.joint_types import JOINT_TYPES
from orthocal.text import composed

Row = Literal["x", "y", "z", "rx", "ry", "rz"]
Coordinate = Literal["x", "y", "z"]
Name = Annotated[str, Field(min_length=1, max_length=200), AfterValidator(composed)]
"""Name of a part of the machine; a URDF permits any characters."""

ClosureKind = Annotated[
    Literal["3d", "6d"],
    BeforeValidator(lambda value: value.lower() if isinstance(value, str) else value),
]
"""Kind of a closure; Gepetto's robots also have upper case."""

LARGEST_ROD_RADIUS_MM = 500.0
"""Largest radius of a rod; larger values have a wrong unit."""

LARGEST_WORKSPACE_MM = 1e4
"""Largest limit of a workspace; larger values have a wrong unit."""

LOWEST_C, HIGHEST_C = -50.0, 100.0
"""Lowest and highest temperature of a machine, [°C]; other values have a wrong unit."""

HEAVIEST_KG = 1e4
"""Largest mass on a tool, [kg]; larger values have a wrong unit."""

MOST_PARTS = 100
"""Largest number of legs, of closures and of named sums."""


class ClosureKeys(Keys):
    """Keys that orthocal adds to one pair of `closed_loop`."""

    rows: list[Row] | None = None
    """Constrained rows, in the axes of the first frame of the pair; all by default."""


class JointKeys(Keys):
    """Joint coordinate of the controller, if it differs from the drive coordinate."""

    counts: Literal["up", "down"] = "up"
    """Direction: up if the joint coordinate grows with the drive coordinate."""
    at_zero_mm: Number | None = None
    """Joint coordinate at the mechanical zero, for a prismatic drive; the drive coordinate by
    default."""
    at_zero_deg: Number | None = None
    """Joint coordinate at the mechanical zero, for a revolute drive."""


class DriveKeys(Keys):
    """Keys that orthocal adds to one motor."""

    zero_mm: Number | None = None
    """Commanded coordinate at the mechanical zero, for a prismatic drive."""
    zero_deg: Number | None = None
    """Commanded coordinate at the mechanical zero, for a revolute drive."""
    joint: JointKeys | None = None
    """Joint coordinate of the controller; the drive coordinate by default."""


class RodKeys(Keys):
    """Round rod of a leg."""

    root: Name
    """Frame on the rod's axis, at the drive's end."""
    tip: Name
    """Frame on the rod's axis, at the platform's end."""
    radius_mm: Annotated[PositiveNumber, Field(le=LARGEST_ROD_RADIUS_MM)]
    """Radius of the rod."""


class LegKeys(Keys):
    """Leg: its centre line, and its rods."""

    root: Name
    """Frame at the drive's end of the leg."""
    tip: Name
    """Frame at the platform's end of the leg."""
    rods: dict[Name, RodKeys] = {}
    """Round rods that a gauge can touch, by name."""


def _require_distinct(names: list[str]) -> list[str]:
    """Refuse a list that names something twice."""
    if len(set(names)) != len(names):
        raise ValueError(f"found [{', '.join(names)}]; expected each name once")
    return names


class TcpKeys(Keys):
    """Tool centre point."""

    frame: Name
    """Frame whose origin it is."""
    coordinates: Annotated[
        list[Coordinate], Field(min_length=1, max_length=3), AfterValidator(_require_distinct)
    ] = ["x", "y", "z"]
    """Commanded world coordinates; one per drive if postures are tool positions."""


def _require_workspace_limits(limits: list[float]) -> list[float]:
    """Require the lower limit of a workspace first, and both within LARGEST_WORKSPACE_MM."""
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
            list[Number],
            Field(min_length=2, max_length=2),
            AfterValidator(_require_workspace_limits),
        ]
    ],
    Field(min_length=1, max_length=3),
]
"""Lower and upper limit of each tool coordinate, relative to the mechanical zero, [mm]."""


class WorkspaceKeys(Keys):
    """Workspace: the region over which errors at the tool are reported."""

    box_mm: WorkspaceBox
    """Limits of the box."""


class BedKeys(Keys):
    """Horizontal surface under the tool."""

    z_mm: Annotated[Number, Field(ge=-LARGEST_WORKSPACE_MM, le=0.0)]
    """Lowest coordinate z of the tool centre point, relative to the mechanical zero: no plan and no
    program moves the tool below it."""


def _require_order(limits: list[float]) -> list[float]:
    """Require that the first of two numbers is not above the second."""
    low, high = limits
    if low > high:
        raise ValueError(f"found [{low:g}, {high:g}]; expected [lowest, highest]")
    return limits


_Range = Annotated[list[Number], Field(min_length=2, max_length=2), AfterValidator(_require_order)]


class UseKeys(Keys):
    """Conditions under which the machine is used."""

    approach: str = "both"
    """Sides of approach: `both`, or a letter for each drive: p if its coordinate grows in the last
    motion, n if it falls, u for both."""
    temperature_C: _Range | None = None
    """Lowest and highest temperature; the reference of the effects by default."""
    payload_kg: _Range = [0.0, 0.0]
    """Lightest and heaviest mass on the tool in addition to the platform."""

    @model_validator(mode="after")
    def _require_within_limits(self) -> UseKeys:
        """Refuse temperatures and masses out of range; the message is "KEY|PROBLEM"."""
        ranges = {
            "temperature_C": (self.temperature_C, LOWEST_C, HIGHEST_C, "degrees Celsius"),
            "payload_kg": (self.payload_kg, 0.0, HEAVIEST_KG, "kilograms"),
        }
        for key, (stated, low, high, unit) in ranges.items():
            if stated is not None and not low <= stated[0] <= stated[1] <= high:
                raise ValueError(f"{key}|found {stated}; expected {unit} from {low:g} to {high:g}")
        return self


class OrthocalKeys(Keys):
    """Keys below `orthocal`."""

    closures: dict[Name, ClosureKeys] | None = None
    """Names of the pairs of `closed_loop`, in their order, mapped to further keys."""
    drives: dict[Name, DriveKeys] = {}
    """Names of motors, mapped to further keys."""
    passive_start: dict[Name, Number] = {}
    """Names of passive joints with suffix `_mm` or `_deg`, mapped to start values for closing the
    loops; 0 by default."""
    legs: Annotated[dict[Name, LegKeys], Field(max_length=MOST_PARTS)] = {}
    """Legs by name."""
    tcp: TcpKeys | None = None
    workspace: WorkspaceKeys | None = None
    bed: BedKeys | None = None
    use: UseKeys = UseKeys()
    parameters: Annotated[
        dict[Name, Annotated[list[Name], Field(min_length=1)]], Field(max_length=MOST_PARTS)
    ] = {}
    """Named sums of elementary errors; a leading '-' subtracts."""
    tolerances: dict[str, Any] = {}
    """Tolerances of geometry and drives, read by `orthocal.effects`."""
    effects: Annotated[dict[Name, dict[str, Any]], Field(max_length=MOST_PARTS)] = {}
    """Further effects by name; each effect reads its keys."""
    adjustments: Annotated[dict[Name, dict[str, Any]], Field(max_length=MOST_PARTS)] = {}
    """Mechanical adjustments by name, read by `orthocal.effects.adjustment`."""
    models: dict[Name, Annotated[list[Name], Field(min_length=1)] | Literal["complete"]] = {}
    """Models by name: patterns of parameter names, or `complete` for all observable errors."""


class RobotKeys(Keys):
    """Keys of a robot's YAML."""

    closed_loop: Annotated[
        list[Annotated[list[Name], Field(min_length=2, max_length=2)]],
        Field(max_length=MOST_PARTS),
    ]
    """Pairs of frames that coincide when the loops are closed."""
    type: list[ClosureKind]
    """Kind of each pair: 3d for the same origin, 6d for the same pose."""
    name_mot: Annotated[list[Name], Field(min_length=1)]
    """Names of the actuated joints (motors)."""
    joint_name: list[Name] = []
    """Names of the joints whose type differs from the URDF."""
    joint_type: list[str] = []
    """Type of each of these joints: FIXED, SPHERICAL, UJOINT_XY (about x, then y) or other axes."""
    orthocal: OrthocalKeys = OrthocalKeys()

    @model_validator(mode="after")
    def _require_consistent(self) -> RobotKeys:
        """Refuse lists of different lengths, repeated names and invalid rows of closures."""
        pairs = len(self.closed_loop)
        if len(self.type) != pairs:
            raise ValueError(f"type has {len(self.type)} entries; closed_loop has {pairs}")
        closures = self.orthocal.closures
        if closures is not None and len(closures) != pairs:
            raise ValueError(
                f"orthocal.closures has {len(closures)} entries; expected one for each of the "
                f"{pairs} pairs of closed_loop, in the same order"
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
        for (name, entry), kind in zip((closures or {}).items(), self.type, strict=False):
            rows = entry.rows
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
        """Refuse invalid joint types."""
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
                raise ValueError(f"joint_name: '{name}' is a motor; its type cannot be changed")

    @property
    def joint_types(self) -> dict[str, str]:
        """Declared types by joint."""
        return dict(zip(self.joint_name, self.joint_type, strict=True))


def load_description(path: Path, *, content: bytes | None = None) -> RobotKeys:
    """Read and validate a robot's YAML.

    Args:
        path: The file.
        content: Content of the file; read from it by default.

    Raises:
        RobotError: If a key is missing or invalid; names file and key.
    """
    data = read_yaml(path, error=RobotError, content=content)
    return validate(RobotKeys, data, where=str(path), error=RobotError)
