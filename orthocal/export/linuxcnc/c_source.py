"""The C sources of a kinematics module: a core in plain C99, and LinuxCNC's component around it.

In the controller's units, mm and degrees, and in the directions in which its joints count. The
component is the same for every machine, but for the coordinates that its drives command.
"""

from __future__ import annotations

from importlib.resources import files
from string import Template

import numpy as np
from numpy.typing import ArrayLike, NDArray

from orthocal.calibration.calibration import Calibration
from orthocal.export.linuxcnc.approximation import Approximation
from orthocal.export.linuxcnc.nominal_form import NominalForm, Tangent
from orthocal.export.linuxcnc.words import LETTERS, as_millimetres, plain, rounded_up
from orthocal.robot.model import Drive
from orthocal.units import DRIVE_UNITS, MM, UM

Array = NDArray[np.float64]


def write_core(calibration: Calibration, found: Approximation) -> dict[str, str]:
    """orthocal_core.c and .h: of points of the tool and joints, without LinuxCNC."""
    inverse, drives = found.inverse, calibration.robot.drives
    counts = np.array([d.direction / DRIVE_UNITS[d.unit][1] for d in drives])
    common = {
        "robot": plain(calibration.robot.name),
        "joints": ", ".join(plain(d.name) for d in drives),
        "joint_units": " and ".join(dict.fromkeys(DRIVE_UNITS[d.unit][0] for d in drives)),
        "drives": len(drives),
    }
    core = {
        **common,
        "title": plain(calibration.session.title) or "without a title",
        "achieved": rounded_up(found.achieved / UM),
        "region": found.region,
        "tool": as_millimetres(found.tool),
        "degree": inverse.degree,
        "terms": len(inverse.exponents),
        "middle": braced(inverse.middle / MM),
        "half": braced(inverse.half / MM),
        "power": braced(inverse.exponents),
        "coefficient": braced(inverse.coefficients * counts[:, None]),
        "nominal": _write_nominal(inverse.nominal, drives, calibration.active_offsets),
    }
    return {
        "orthocal_core.c": _fill("orthocal_core.c", core),
        "orthocal_core.h": _fill("orthocal_core.h", common),
    }


def write_component(found: Approximation) -> dict[str, str]:
    """orthocal_kins.c: the core as a kinematics module."""
    carried = [k for k in range(len(LETTERS)) if k not in found.coordinates]
    values = {"commanded": braced(found.coordinates), "carried": braced(carried)}
    return {"orthocal_kins.c": _fill("orthocal_kins.c", values)}


def _write_nominal(form: NominalForm, drives: tuple[Drive, ...], active: Array) -> str:
    """The nominal form in joints, with the offsets that are in the controller and stay there."""
    counts = np.array([d.direction for d in drives])
    sizes = np.array([DRIVE_UNITS[d.unit][1] for d in drives])

    def show(coordinates: Array) -> Array:
        values = coordinates + active
        shown = np.array([d.to_joint(v) for d, v in zip(drives, values, strict=True)])
        return np.asarray(shown / sizes)

    if isinstance(form, Tangent):
        values = {
            "at_middle": braced(show(form.values)),
            "tangent": braced(form.slopes * (counts * MM / sizes)[:, None]),
        }
        return _fill("tangent.c", values)
    values = {
        "axis": braced(form.axes),
        "anchor": braced(form.anchors / MM),
        "length": braced(form.lengths / MM),
        "sign": braced(form.signs),
        "counts": braced(counts),
        "shown": braced(show(np.zeros(len(drives)))),
    }
    return _fill("slides.c", values)


def braced(values: ArrayLike, *, indent: int = 4) -> str:
    """Numbers as C has them: every digit of doubles, integers as integers, nested as the array."""
    array = np.asarray(values)
    pad = " " * indent
    if array.ndim > 1:
        rows = [f"{pad}{braced(row, indent=indent + 4)}" for row in array]
        return "{\n" + ",\n".join(rows) + f"\n{' ' * (indent - 4)}}}"
    if np.issubdtype(array.dtype, np.integer):
        texts = [str(int(v)) for v in array]
    else:
        texts = [repr(float(v) + 0.0) for v in array]
    line = "{" + ", ".join(texts) + "}"
    if len(line) <= 90:
        return line
    lines = [", ".join(texts[i : i + 3]) for i in range(0, len(texts), 3)]
    return "{\n" + ",\n".join(f"{pad}{part}" for part in lines) + f"\n{' ' * (indent - 4)}}}"


def _fill(name: str, values: dict[str, object] | dict[str, str]) -> str:
    template = files("orthocal.export.linuxcnc").joinpath("templates", name)
    return Template(template.read_text(encoding="utf-8")).substitute(values)
