"""C sources of a kinematics module: a core in plain C99, and a LinuxCNC component around it.

Numbers are in the controller's units, mm and degrees, and in its joint directions. The component
depends on the machine only through the coordinates that the drives command.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib.resources import files
from string import Template

import numpy as np
from numpy.typing import ArrayLike

from orthocal.arrays import Array
from orthocal.calibration.calibration import Calibration
from orthocal.export.linuxcnc.approximation import (
    LETTERS,
    Approximation,
    ThermalChange,
    millimetres,
    rounded_up,
)
from orthocal.export.linuxcnc.drive_compensation import find_periodic_errors
from orthocal.export.linuxcnc.home_offsets import JointHome
from orthocal.export.linuxcnc.nominal_form import NominalForm, Tangent
from orthocal.text import comment_safe
from orthocal.units import MM, UM

LONGEST_LINE = 90


def write_core(
    calibration: Calibration,
    approximation: Approximation,
    homes: Sequence[JointHome],
) -> dict[str, str]:
    """Texts of orthocal_core.c and orthocal_core.h, which do not depend on LinuxCNC.

    Args:
        calibration: The calibration.
        approximation: Approximate inverse kinematics without periodic errors of screws.
        homes: Joints with their compensation in the controller.
    """
    drives, inverse = calibration.robot.drives, approximation.inverse
    polynomial = inverse.correction
    to_joints = np.array([d.direction / d.joint_size for d in drives])
    common = {
        "robot": comment_safe(calibration.robot.name),
        "joints": ", ".join(comment_safe(d.name) for d in drives),
        "joint_units": " and ".join(dict.fromkeys(d.joint_unit for d in drives)),
        "drives": len(drives),
    }
    screws = _write_screws(calibration, homes)
    common["functions"] = "sqrt, sin and cos" if screws["periodic"] else "sqrt"
    thermal = _write_thermal(inverse.thermal, to_joints)
    common |= {name: thermal.pop(name) for name in ("thermal", "reference", "lowest", "highest")}
    core = {
        **common,
        "title": comment_safe(calibration.session.title) or "session without a title",
        "achieved": rounded_up(approximation.achieved / UM),
        "region": approximation.region,
        "tool": millimetres(approximation.tool),
        "degree": polynomial.degree,
        "terms": len(polynomial.exponents),
        "middle": braced(polynomial.middle / MM),
        "half": braced(polynomial.half / MM),
        "exponent": braced(polynomial.exponents),
        "coefficient": braced(polynomial.coefficients * to_joints[:, None]),
        "nominal": _write_nominal(inverse.nominal, calibration),
        **screws,
        **thermal,
    }
    return {
        "orthocal_core.c": fill_template("orthocal_core.c", core),
        "orthocal_core.h": fill_template("orthocal_core.h", common),
    }


def write_component(approximation: Approximation) -> dict[str, str]:
    """Text of orthocal_kins.c, the kinematics module around the core."""
    coordinates = approximation.coordinates
    identity = [k for k in range(len(LETTERS)) if k not in coordinates]
    values = {"commanded": braced(coordinates), "identity": braced(identity)}
    return {"orthocal_kins.c": fill_template("orthocal_kins.c", values)}


def _write_thermal(change: ThermalChange | None, to_joints: Array) -> dict[str, object]:
    """Values of the template: change of the joints per kelvin, reference and limits."""
    if change is None:
        zeros: dict[str, object] = dict.fromkeys(("reference", "lowest", "highest"), "0.0")
        return {**zeros, "thermal": 0, "per_kelvin": "{{0.0}}"}
    return {
        "thermal": 1,
        "reference": repr(change.reference),
        "lowest": repr(change.lowest),
        "highest": repr(change.highest),
        "per_kelvin": braced(change.per_kelvin.coefficients * to_joints[:, None]),
    }


def _write_screws(calibration: Calibration, homes: Sequence[JointHome]) -> dict[str, object]:
    """Values of the template: periodic errors of the screws, and trims of the joints at home."""
    drives = calibration.robot.drives
    units = np.array([d.joint_size for d in drives])
    directions = np.array([d.direction for d in drives])
    home = [h.compensation.trim_at_home(h.old) - h.was.trim_at_home(h.old) for h in homes]
    periodic = find_periodic_errors(calibration.robot, calibration.errors)
    sine, cosine = (
        np.zeros((2, len(drives)))
        if periodic is None
        else np.array([periodic.sine, periodic.cosine]) * directions
    )
    return {
        "home": braced(home / units),
        "periodic": int(periodic is not None),
        "rate": repr(0.0 if periodic is None else 2.0 * np.pi * MM / periodic.lead),
        "sine": braced(sine / units),
        "cosine": braced(cosine / units),
        "screw_direction": braced(directions),
        "screw_zero": braced(_to_joints(calibration, np.zeros(len(drives)))),
    }


def _to_joints(calibration: Calibration, coordinates: Array) -> Array:
    """Joint coordinates, [mm or degrees], of drive coordinates with the active offsets."""
    values = (coordinates + calibration.active_offsets).tolist()
    drives = zip(calibration.robot.drives, values, strict=True)
    return np.array([d.to_joint(v) / d.joint_size for d, v in drives])


def _write_nominal(form: NominalForm, calibration: Calibration) -> str:
    """C source of the nominal form in joints, with the active offsets of the controller."""
    drives = calibration.robot.drives
    directions = np.array([d.direction for d in drives])
    if isinstance(form, Tangent):
        units = np.array([d.joint_size for d in drives])
        values = {
            "at_middle": braced(_to_joints(calibration, form.values)),
            "jacobian": braced(form.jacobian * (directions * MM / units)[:, None]),
        }
        return fill_template("tangent.c", values)
    values = {
        "axis": braced(form.axes),
        "anchor": braced(form.anchors / MM),
        "length": braced(form.lengths / MM),
        "sign": braced(form.signs),
        "direction": braced(directions),
        "at_zero": braced(_to_joints(calibration, np.zeros(len(drives)))),
    }
    return fill_template("slides.c", values)


def braced(values: ArrayLike, *, indent: int = 4) -> str:
    """C initializer of an array of integers, or of doubles with all digits.

    Args:
        values: The array.
        indent: Indentation of its rows.
    """
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
    if len(line) <= LONGEST_LINE:
        return line
    lines = [", ".join(texts[i : i + 3]) for i in range(0, len(texts), 3)]
    return "{\n" + ",\n".join(f"{pad}{line}" for line in lines) + f"\n{' ' * (indent - 4)}}}"


def fill_template(name: str, values: Mapping[str, object]) -> str:
    """Text of a file in templates/ with its $names replaced by values."""
    template = files("orthocal.export.linuxcnc").joinpath("templates", name)
    return Template(template.read_text(encoding="utf-8")).substitute(values)
