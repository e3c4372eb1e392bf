"""A scene: meshcat's commands, kept instead of sent, and what a page shows around them.

meshcat's own window starts a server that other machines can reach and that outlives its parent.
A scene needs none: it keeps the commands, and a page plays them to meshcat's viewer, from a file
or from a server that listens on this machine only (`live`).
"""

from __future__ import annotations

import base64
import html
import json
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, field
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any, Literal

import meshcat
import numpy as np
import umsgpack
from meshcat.animation import Animation
from meshcat.geometry import Geometry, Material
from numpy.typing import NDArray

from orthocal.io.files import write_file
from orthocal.text import printable

Array = NDArray[np.float64]
Point = tuple[float, float, float]
Mark = Literal["solid", "ghost", "arrow", "line", "ball"]

_POLICY = (
    "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; "
    "img-src data: blob:; connect-src {connect}"
)
"""A page may load nothing, whatever a file from a stranger has put into it."""


@dataclass(frozen=True, slots=True)
class Label:
    """A text at a point of the scene; pages keep labels from covering each other."""

    at: tuple[Point, ...]
    """One a step of the animation, or one for all, [m]."""
    texts: tuple[str, ...]
    """The same; empty where there is none."""
    node: str
    """Path of the node that it belongs to: it is hidden with that."""
    rank: float = 0.0
    """Where there is no room for all, those of the highest rank stay; below 0 a name, not a box."""
    uncovered: tuple[tuple[Point, ...], ...] = ()
    """Points a step around all of which no label stands, [m]."""


@dataclass(frozen=True, slots=True)
class LegendEntry:
    """A line of the legend, with a box that shows and hides nodes."""

    text: str
    nodes: tuple[str, ...]
    colour: str
    """CSS."""
    mark: Mark
    shown: bool = True
    """At first."""


@dataclass(frozen=True, slots=True)
class Step:
    """A stage of the animation."""

    name: str
    caption: str
    start: float
    """[s]."""
    end: float
    """[s]."""


@dataclass(frozen=True, slots=True)
class Camera:
    """Where the scene is looked at from."""

    target: Point
    """[m]."""
    direction: Point
    """From the target to the camera."""
    points: tuple[Point, ...] = ((-0.5, -0.5, -0.5), (0.5, 0.5, 0.5))
    """What is in view at first, [m]."""


class _Recorder:
    """Stands in for meshcat's window: keeps commands in their order."""

    def __init__(self, to_html: Callable[[], str]) -> None:
        self.commands: list[dict[str, Any]] = []
        self.listeners: list[Callable[[], object]] = []
        self._names: dict[str, str] = {}
        self._to_html = to_html

    def send(self, command: Any) -> None:  # noqa: ANN401 - any of meshcat's commands
        self.commands.append(self._plain(command.lower()))
        for listener in tuple(self.listeners):
            listener()

    def get_scene(self) -> str:
        """For `static_html` of meshcat's interface."""
        return self._to_html()

    def _plain(self, value: Any) -> Any:  # noqa: ANN401 - a JSON-like tree
        """The same with plain numbers, and names counted instead of drawn at random."""
        if isinstance(value, dict):
            return {k: self._plain(v) for k, v in value.items()}
        if isinstance(value, list | tuple):
            if all(type(v) is float for v in value):  # most of what there is
                return list(value)
            return [self._plain(v) for v in value]
        if isinstance(value, np.generic):
            return value.item()
        if isinstance(value, str) and len(value) == 36 and value.count("-") == 4:
            return self._names.setdefault(value, f"o{len(self._names)}")
        return value


@dataclass(eq=False)
class Scene:
    """Something to look at in a browser."""

    title: str
    headline: str = ""
    """What is to be seen, in a sentence."""
    facts: list[str] = field(default_factory=list)
    """Scales and what else has to be said, a line each."""
    camera: Camera = Camera((0.0, 0.0, 0.0), (1.0, 1.0, 0.7))
    labels: list[Label] = field(default_factory=list)
    legend: list[LegendEntry] = field(default_factory=list)
    steps: list[Step] = field(default_factory=list)
    exaggeration: float = 1.0
    """How many times its size the machine's deviation is drawn."""
    arrow_scale: float = 1.0
    """Drawn length of an arrow at a gauge over the reading that it stands for."""
    tool_scale: float = 1.0
    """The same for errors of the tool."""

    def __post_init__(self) -> None:
        self._recorder = _Recorder(self.to_html)
        self.visualizer = meshcat.Visualizer(window=self._recorder)
        """meshcat's interface to this scene; `scene.visualizer["/Name"]` adds to it."""

    def add(self, path: str, geometry: Geometry, material: Material) -> None:
        """Put a shape at a node.

        Args:
            path: Names with slashes between.
            geometry: One of meshcat's.
            material: One of meshcat's.
        """
        self.visualizer[f"/{path}"].set_object(geometry, material)

    def place(self, path: str, pose: Array) -> None:
        """Move a node: shape (4, 4), [m]."""
        self.visualizer[f"/{path}"].set_transform(np.asarray(pose, dtype=np.float64))

    def set_property(self, path: str, name: str, value: object) -> None:
        """Set a property of a node, such as `visible`."""
        self.visualizer[f"/{path}"].set_property(name, value)

    def explain(self, entry: LegendEntry) -> None:
        """Add a line to the legend; what it says is not shown at first is hidden."""
        self.legend.append(entry)
        for node in entry.nodes:
            self.set_property(node, "visible", entry.shown)

    def animate(self, animation: Animation) -> None:
        """Give the scene its animation; it waits for someone to play it."""
        self.visualizer.set_animation(animation, play=False)

    @property
    def listeners(self) -> list[Callable[[], object]]:
        """What is called after every command; to be added to and taken from."""
        return self._recorder.listeners

    @property
    def commands(self) -> tuple[Mapping[str, Any], ...]:
        """All commands so far, as meshcat's viewer takes them."""
        return tuple(self._recorder.commands)

    @property
    def nodes(self) -> tuple[str, ...]:
        """Paths of all nodes that hold a shape, in the order in which they came."""
        found = (c["path"] for c in self.commands if c["type"] == "set_object")
        return tuple(dict.fromkeys(path.strip("/") for path in found))

    def pose(self, path: str) -> Array:
        """Where a node is, in its parent, shape (4, 4), [m].

        Raises:
            KeyError: If there is no such node.
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
        """Commands from one on, as meshcat's viewer takes them from a server."""
        for command in self.commands[start:]:
            # the viewer keeps what moves in single precision anyway
            precision = "single" if command["type"] == "set_animation" else "double"
            yield umsgpack.packb(command, force_float_precision=precision)

    def to_html(self) -> str:
        """One page that holds all it needs, meshcat's viewer too."""
        packed = [base64.b64encode(data).decode() for data in self.pack()]
        return self._page(packed, viewer=f"<script>{viewer_script()}</script>", connect="'none'")

    def to_live_html(self) -> str:
        """A page that takes the viewer and the commands from the server that it came from."""
        # not every browser counts a socket of its own server among 'self'
        own = "'self' ws://127.0.0.1:* ws://localhost:*"
        return self._page([], viewer='<script src="main.min.js"></script>', connect=own)

    def save(self, path: str | Path) -> Path:
        """Write the page.

        Raises:
            OrthocalError: If it cannot be written.
        """
        write_file(Path(path), self.to_html())
        return Path(path)

    def _repr_html_(self) -> str:
        """In a notebook: the page in a frame."""
        return frame_of(self.to_html(), height="560px")

    def _page(self, commands: list[str], *, viewer: str, connect: str) -> str:
        policy = _POLICY.format(connect=connect)
        if connect != "'none'":
            policy = policy.replace("script-src", "script-src 'self'")
        content = {
            "title": self.title,
            "headline": self.headline,
            "facts": self.facts,
            "camera": asdict(self.camera),
            "labels": [asdict(label) for label in self.labels],
            "legend": [asdict(entry) for entry in self.legend],
            "steps": [asdict(step) for step in self.steps],
            "commands": commands,
            "live": connect != "'none'",
        }
        # the only places where </script> could end: no "<" is left in the data
        shown = _printable(content)
        data = json.dumps(shown, ensure_ascii=False, allow_nan=False).replace("<", "\\u003c")
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


_NAMES_OF_JAVASCRIPT = frozenset(
    "constructor hasOwnProperty isPrototypeOf propertyIsEnumerable toLocaleString toString valueOf "
    "__defineGetter__ __defineSetter__ __lookupGetter__ __lookupSetter__ __proto__ "
    "<object>".split()
)
"""What the viewer's tables of nodes, which are plain objects, hold before there is any node; and
its own name for the shape of a node."""


def node_name(name: str) -> str:
    """A name from a file as a node's: a slash would be a level, and some names are taken."""
    shown = printable(name.replace("/", "∕"))
    return f"{shown} (name)" if shown in _NAMES_OF_JAVASCRIPT else shown


def frame_of(page: str, *, height: str) -> str:
    """A page inside another one."""
    style = f"width:100%;height:{height};border:1px solid #ccc;border-radius:6px"
    source = html.escape(page)
    return f'<iframe title="3-D scene" loading="lazy" srcdoc="{source}" style="{style}"></iframe>'


@cache
def viewer_script() -> str:
    """The viewer of meshcat, from the installed package."""
    path = resources.files("meshcat") / "viewer" / "dist" / "main.min.js"
    return path.read_text(encoding="utf-8").replace("</script", "<\\/script")


def round_scale(value: float) -> float:
    """The next lower of 1, 1.2, 1.5, 2, 2.5, 3, 4, 5, 6, 8 times a power of ten; at least 1."""
    if not (math.isfinite(value) and value > 1.0):
        return 1.0
    power = 10.0 ** math.floor(math.log10(value))
    steps = (1.0, 1.2, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0, 8.0)
    return max(s for s in steps if s * power <= value * (1.0 + 1e-12)) * power


def _printable(value: Any) -> Any:  # noqa: ANN401 - a JSON-like tree
    """The same with every text as it can be shown: none turns the order of others about."""
    if isinstance(value, str):
        return printable(value, keep="\n")
    if isinstance(value, dict):
        return {k: _printable(v) for k, v in value.items()}
    return [_printable(v) for v in value] if isinstance(value, list | tuple) else value


def _read(name: str) -> str:
    return (resources.files("orthocal.viewer") / "web" / name).read_text(encoding="utf-8")
