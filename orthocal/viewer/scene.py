"""Scenes: recorded meshcat commands, and the content of a page around the 3-D view.

The window of meshcat starts a server that other machines can reach and that outlives its parent
process. A scene records the commands instead. A page sends them to meshcat's viewer, either from a
file or from the server of `live`, which only this machine can reach.
"""

from __future__ import annotations

import base64
import html
import json
import math
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, field
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any, Literal

import meshcat
import numpy as np
import umsgpack
from meshcat.animation import Animation, AnimationClip, AnimationTrack
from meshcat.geometry import Geometry, Material
from meshcat.path import Path as NodePath

from orthocal.arrays import Array
from orthocal.io.files import write_file
from orthocal.text import printable

Point = tuple[float, float, float]
Mark = Literal["solid", "ghost", "arrow", "line", "ball"]

_POLICY = (
    "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; "
    "img-src data: blob:; connect-src {connect}"
)
"""Security policy of a page: no content from other sources, regardless of the user's files."""

FRAME_RATE = 30
"""Frames of the animation per second."""

_IDENTIFIER = re.compile("[0-9a-f]{8}(-[0-9a-f]{4}){3}-[0-9a-f]{12}")
"""Random identifier of meshcat."""

SMALLEST_CHANGE = 1e-12
"""Changes below this are not animated, [m or 1]."""


@dataclass(frozen=True, slots=True)
class Label:
    """Text at a point of the scene; the page places labels without overlap."""

    at: tuple[Point, ...]
    """Point in each step of the animation, or one point for all steps, [m]."""
    texts: tuple[str, ...]
    """Text in each step, or one text for all steps; "" for no label."""
    node: str
    """Path of the node; the label is hidden with it."""
    rank: float = 0.0
    """Priority of the label if not all fit; names have rank -1."""
    uncovered: tuple[tuple[Point, ...], ...] = ()
    """Points in each step that no label may cover, [m]."""


@dataclass(frozen=True, slots=True)
class LegendEntry:
    """Line of the legend, with a check box that shows and hides its nodes."""

    text: str
    nodes: tuple[str, ...]
    """Paths of the nodes."""
    colour: str
    """Colour in CSS."""
    mark: Mark
    """Symbol before the text."""
    shown: bool = True
    """Whether the nodes are initially visible."""


@dataclass(frozen=True, slots=True)
class Step:
    """Stop of the animation."""

    name: str
    caption: str
    start: float
    """Time of arrival, [s]."""
    end: float
    """Time of departure, [s]."""


@dataclass(frozen=True, slots=True)
class Camera:
    """Initial view of the scene."""

    target: Point
    """Point in the middle of the view, [m]."""
    direction: Point
    """Direction from the target to the camera."""
    points: tuple[Point, ...] = ((-0.5, -0.5, -0.5), (0.5, 0.5, 0.5))
    """Points that are initially in view, [m]."""


class _Recorder:
    """Replacement of meshcat's window that records the commands in order.

    Args:
        to_html: Function that returns the page.
    """

    def __init__(self, to_html: Callable[[], str]) -> None:
        self.commands: list[dict[str, Any]] = []
        self.listeners: list[Callable[[], object]] = []
        self._names: dict[str, str] = {}
        self._to_html = to_html

    def send(self, command: Any) -> None:  # noqa: ANN401 - any of meshcat's commands
        """Record a command and call the listeners."""
        self.commands.append(self._plain(command.lower()))
        for listener in tuple(self.listeners):
            listener()

    def get_scene(self) -> str:
        """Page of the scene, for `static_html` of meshcat's interface."""
        return self._to_html()

    def _plain(self, value: Any) -> Any:  # noqa: ANN401 - a JSON-like tree
        """Copy with plain numbers, and with counters instead of random identifiers."""
        if isinstance(value, dict):
            return {k: self._plain(v) for k, v in value.items()}
        if isinstance(value, list | tuple):
            if all(type(v) is float for v in value):  # a fast path for most of the data
                return list(value)
            return [self._plain(v) for v in value]
        if isinstance(value, np.generic):
            return value.item()
        if isinstance(value, str) and _IDENTIFIER.fullmatch(value):
            return self._names.setdefault(value, f"o{len(self._names)}")
        return value


@dataclass(eq=False)
class Scene:
    """3-D scene with legend, labels and animation for a browser."""

    title: str
    headline: str = ""
    """Main result in a sentence."""
    facts: list[str] = field(default_factory=list)
    """Scales and further facts, one per line."""
    camera: Camera = Camera((0.0, 0.0, 0.0), (1.0, 1.0, 0.7))
    labels: list[Label] = field(default_factory=list)
    legend: list[LegendEntry] = field(default_factory=list)
    steps: list[Step] = field(default_factory=list)
    exaggeration: float = 1.0
    """Factor by which the deviation of the machine is enlarged."""
    arrow_scale: float = 1.0
    """Drawn length of an arrow at a gauge divided by its reading."""
    tool_scale: float = 1.0
    """Drawn length of an arrow at the tool divided by its error."""

    def __post_init__(self) -> None:
        self._recorder = _Recorder(self.to_html)
        self._clips: dict[NodePath, AnimationClip] = {}
        self.visualizer = meshcat.Visualizer(window=self._recorder)
        """Interface of meshcat to this scene; `scene.visualizer["/Name"]` adds nodes."""

    def add(
        self, path: str, geometry: Geometry, material: Material, pose: Array | None = None
    ) -> None:
        """Add a shape.

        Args:
            path: Path of its node, with names separated by slashes.
            geometry: Geometry of meshcat.
            material: Material of meshcat.
            pose: Pose in the parent node, shape (4, 4), [m].
        """
        self.visualizer[f"/{path}"].set_object(geometry, material)
        if pose is not None:
            self.place(path, pose)

    def place(self, path: str, pose: Array) -> None:
        """Set the pose of a node in its parent, shape (4, 4), [m]."""
        self.visualizer[f"/{path}"].set_transform(np.asarray(pose, dtype=np.float64))

    def move(self, path: str, times: Array, poses: Array) -> None:
        """Place a node at the first of several poses and animate it through all poses.

        Args:
            path: Path of the node.
            times: Times of the poses, shape (F,), [frames].
            poses: Poses in the parent node, shape (F, 4, 4), [m].
        """
        from scipy.spatial.transform import Rotation

        self.place(path, poses[0])
        if np.ptp(poses[:, :3, 3], axis=0).max() > SMALLEST_CHANGE:
            self.track(path, "position", "vector3", times, poses[:, :3, 3])
        if np.ptp(poses[:, :3, :3], axis=0).max() > SMALLEST_CHANGE:
            rotations = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
            self.track(path, "quaternion", "quaternion", times, rotations)

    def track(self, path: str, name: str, kind: str, times: Array, values: Array) -> None:
        """Animate a property of a node.

        Args:
            path: Path of the node.
            name: Property, such as `position`.
            kind: Type of the property in three.js, such as `vector3`.
            times: Times of the values, shape (F,), [frames].
            values: Values, shape (F, n) or (F,).
        """
        node = NodePath(tuple(path.split("/")))
        clip = self._clips.setdefault(node, AnimationClip(fps=FRAME_RATE))
        clip.tracks[name] = AnimationTrack(name, kind, times.tolist(), values.tolist())

    def animate(self) -> None:
        """Add the animation of all tracks; it is initially stopped."""
        self.visualizer.set_animation(
            Animation(self._clips, default_framerate=FRAME_RATE), play=False
        )

    def set_property(self, path: str, name: str, value: object) -> None:
        """Set a property of a node, such as `visible`."""
        self.visualizer[f"/{path}"].set_property(name, value)

    def explain(self, entry: LegendEntry) -> None:
        """Add a line to the legend, and show or hide its nodes."""
        self.legend.append(entry)
        for node in entry.nodes:
            self.set_property(node, "visible", entry.shown)

    @property
    def listeners(self) -> list[Callable[[], object]]:
        """Functions that are called after every command; append to this list to add one."""
        return self._recorder.listeners

    @property
    def commands(self) -> tuple[Mapping[str, Any], ...]:
        """All recorded commands, in the form of meshcat's viewer."""
        return tuple(self._recorder.commands)

    @property
    def nodes(self) -> tuple[str, ...]:
        """Paths of all nodes with a shape, in the order of their creation."""
        paths = (c["path"] for c in self.commands if c["type"] == "set_object")
        return tuple(dict.fromkeys(path.strip("/") for path in paths))

    def pose(self, path: str) -> Array:
        """Pose of a node in its parent, shape (4, 4), [m].

        Raises:
            KeyError: If the node does not exist.
        """
        path, pose = path.strip("/"), np.eye(4)
        paths = [c["path"].strip("/") for c in self.commands]
        if not any(p == path or p.startswith(f"{path}/") for p in paths):
            raise KeyError(path)
        for command in self.commands:
            if command["type"] == "set_transform" and command["path"].strip("/") == path:
                pose = np.array(command["matrix"]).reshape(4, 4).T
        return pose

    def pack(self, start: int = 0) -> Iterator[bytes]:
        """Commands from number `start` on, packed for meshcat's viewer."""
        for command in self.commands[start:]:
            # the viewer animates in single precision
            precision = "single" if command["type"] == "set_animation" else "double"
            yield umsgpack.packb(command, force_float_precision=precision)

    def to_html(self) -> str:
        """Self-contained page that includes meshcat's viewer."""
        packed = [base64.b64encode(data).decode() for data in self.pack()]
        return self._page(packed, viewer=f"<script>{viewer_script()}</script>", connect="'none'")

    def to_live_html(self) -> str:
        """Page that loads the viewer and the commands from its server."""
        # some browsers do not count web sockets of the same server as 'self'
        server = "'self' ws://127.0.0.1:* ws://localhost:*"
        return self._page([], viewer='<script src="main.min.js"></script>', connect=server)

    def save(self, path: str | Path) -> Path:
        """Write the self-contained page.

        Raises:
            OrthocalError: If the file cannot be written.
        """
        write_file(Path(path), self.to_html())
        return Path(path)

    def _repr_html_(self) -> str:
        """Page in a frame, for notebooks."""
        return frame_of(self.to_html(), height="560px")

    def _page(self, commands: list[str], *, viewer: str, connect: str) -> str:
        """Page of the scene.

        Args:
            commands: Packed commands in base64.
            viewer: Script element with meshcat's viewer.
            connect: Sources to which the page may connect.
        """
        policy = _POLICY.format(connect=connect)
        if connect != "'none'":
            policy = policy.replace("script-src", "script-src 'self'")
        shown = ("title", "headline", "facts", "camera", "labels", "legend", "steps")
        fields = asdict(self)
        content = {name: fields[name] for name in shown}
        content |= {"commands": commands, "live": connect != "'none'"}
        # escape "<", so that the data cannot end the script element
        data = json.dumps(_printable(content), ensure_ascii=False, allow_nan=False).replace(
            "<", "\\u003c"
        )
        parts = {
            "TITLE": html.escape(printable(self.title)),
            "POLICY": policy,
            "STYLE": _read("scene.css"),
            "VIEWER": viewer,
            "DATA": data,
            "SCRIPT": _read("scene.js"),
        }
        page = _read("scene.html")
        pieces = page.split("@@")  # text, name, text, name, ..., text
        return "".join(parts[p] if i % 2 else p for i, p in enumerate(pieces))


_RESERVED_NAMES = frozenset(
    "constructor hasOwnProperty isPrototypeOf propertyIsEnumerable toLocaleString toString valueOf "
    "__defineGetter__ __defineSetter__ __lookupGetter__ __lookupSetter__ __proto__ "
    "<object>".split()
)
"""Keys of every plain object of JavaScript, in which the viewer stores its nodes, and
its name for the shape of a node."""


def node_name(name: str) -> str:
    """Node name for a name from a file, without slashes and reserved names of the viewer."""
    text = printable(name.replace("/", "∕"))
    return f"{text} (name)" if text in _RESERVED_NAMES else text


def frame_of(page: str, *, height: str) -> str:
    """HTML of a frame that contains a page."""
    style = f"width:100%;height:{height};border:1px solid #ccc;border-radius:6px"
    source = html.escape(page)
    return f'<iframe title="3-D scene" loading="lazy" srcdoc="{source}" style="{style}"></iframe>'


@cache
def viewer_script() -> str:
    """Script of meshcat's viewer from the installed package."""
    path = resources.files("meshcat") / "viewer" / "dist" / "main.min.js"
    return path.read_text(encoding="utf-8").replace("</script", "<\\/script")


def round_scale(value: float) -> float:
    """Largest of 1, 1.2, 1.5, 2, 2.5, 3, 4, 5, 6, 8 times 10ⁿ up to a value; at least 1."""
    if not (math.isfinite(value) and value > 1.0):
        return 1.0
    power = 10.0 ** math.floor(math.log10(value))
    steps = (1.0, 1.2, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0, 8.0)
    return max(s for s in steps if s * power <= value * (1.0 + 1e-12)) * power


def _printable(value: Any) -> Any:  # noqa: ANN401 - a JSON-like tree
    """Copy with printable texts, without characters that change the writing direction."""
    if isinstance(value, str):
        return printable(value, keep="\n")
    if isinstance(value, dict):
        return {k: _printable(v) for k, v in value.items()}
    return [_printable(v) for v in value] if isinstance(value, list | tuple) else value


def _read(name: str) -> str:
    """Text of a file in web/."""
    return (resources.files("orthocal.viewer") / "web" / name).read_text(encoding="utf-8")
