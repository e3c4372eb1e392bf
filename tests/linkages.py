"""Small robots of any kind, written into a folder: joints in lines, loops and motors in a YAML."""

from __future__ import annotations

from pathlib import Path

from orthocal import load_robot
from orthocal.robot.model import Robot

AXES = {"x": "1 0 0", "y": "0 1 0", "z": "0 0 1"}
FREE = '<limit effort="1" velocity="1"/>'
"""Neither lower nor upper, as a CAD export writes it."""


def joint(name, parent, origin, axis, *, kind="revolute", limit=FREE):
    """A joint of this name with a link of the same name; axis '' for a fixed one."""
    place = " ".join(str(v) for v in origin)
    rest = f'<axis xyz="{AXES[axis]}"/>{limit}' if axis else ""
    return (
        f'  <link name="{name}"/>\n'
        f'  <joint name="{name}" type="{kind if axis else "fixed"}"><parent link="{parent}"/>'
        f'<child link="{name}"/><origin xyz="{place}"/>{rest}</joint>\n'
    )


def chain(joints, *, parent="base", prefix="j"):
    """Joints in series, (origin, axis) each, named j0, j1, ..."""
    text = ""
    for i, (origin, axis) in enumerate(joints):
        text += joint(f"{prefix}{i}", parent, origin, axis)
        parent = f"{prefix}{i}"
    return text


def write_robot(folder: Path, joints: str, yaml: str) -> Path:
    """Folder of a robot with these joints (after the link 'base') and this YAML."""
    folder.mkdir(parents=True, exist_ok=True)
    head = f'<robot name="{folder.name}">\n  <link name="base"/>\n'
    (folder / f"{folder.name}.urdf").write_text(f"{head}{joints}</robot>\n")
    (folder / f"{folder.name}.yaml").write_text(yaml)
    return folder


def make_robot(folder: Path, joints: str, yaml: str) -> Robot:
    """The same, loaded."""
    return load_robot(write_robot(folder, joints, yaml))


# ---- robots with the traits of other people's


def write_crooked_loop(folder: Path) -> Path:
    """Seven hinges in a spatial loop; the shortest steps of Newton's method never close it."""
    origins = [(0, 0, 0), (0.1, -0.1, 0), (0, 0, 0), (-0.1, 0, 0), (0.1, 0, 0), (0.1, -0.1, 0)]
    joints = chain(zip([*origins, (-0.1, 0, 0)], "zzxyzxy", strict=True))
    joints += joint("end", "j6", (0, 0, 0), "") + joint("post", "base", (-0.1, 0, -0.1), "")
    return write_robot(folder, joints, "closed_loop: [[end, post]]\ntype: [6D]\nname_mot: [j0]\n")


def write_wide_linkage(folder: Path, extra: str = "", *, half: float = 0.3) -> Path:
    """A planar five-bar whose elbows are 2 half + 0.2 apart at 0; its rods reach 0.6."""
    joints = ""
    for side, sign in (("a", -1.0), ("b", 1.0)):
        joints += joint(f"motor_{side}", "base", (sign * half, 0, 0), "z")
        joints += joint(f"elbow_{side}", f"motor_{side}", (sign * 0.1, 0, 0), "z")
        joints += joint(f"end_{side}", f"elbow_{side}", (-sign * 0.2, 0.05**0.5, 0), "")
    loop = "closed_loop: [[end_a, end_b]]\ntype: [3d]\nname_mot: [motor_a, motor_b]\n"
    rows = "closures: {apex: {rows: [x, y]}}"
    return write_robot(folder, joints, f"{loop}orthocal:\n  {rows}\n{extra}")


def write_ball_platform(folder: Path, kind: str = "SPHERICAL") -> Path:
    """Two legs that carry a plate: a crank, a rod and, at its end, what stands for a ball joint."""
    joints = ""
    for side, sign in (("a", -1.0), ("b", 1.0)):
        joints += joint(f"motor_{side}", "base", (sign * 0.1, 0, 0), "y")
        joints += joint(f"rod_{side}", f"motor_{side}", (sign * 0.05, 0.01, 0.1), "y")
        joints += joint(f"ball_{side}", f"rod_{side}", (-sign * 0.05, 0, 0.15), "z")
    joints += joint("plate", "ball_a", (0.2, 0.0, 0.02), "") + joint(
        "seat", "ball_b", (0, 0, 0.02), ""
    )
    return write_robot(
        folder,
        joints,
        "closed_loop: [[plate, seat]]\ntype: ['6D']\nname_mot: [motor_a, motor_b]\n"
        f"joint_name: [ball_a, ball_b]\njoint_type: [{kind}, {kind}]\n",
    )
