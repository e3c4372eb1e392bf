"""calibration.json: written, read and checked, for it may come from a stranger or an editor.

The record (`records.py`) is its schema. Beside it stand numbers that follow from the record, for
those who read the file without orthocal; on loading each is held against what it follows from.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from orthocal.calibration.calibration import Calibration
from orthocal.calibration.recorded_robot import (
    load_recorded_robot,
    require_offsets,
    require_parameters,
    require_rows,
)
from orthocal.calibration.records import CalibrationRecord
from orthocal.errors import CalibrationFileError, SolverError
from orthocal.io.documents import read_json, validate, write_plain
from orthocal.io.fields import finite_or_none
from orthocal.io.files import exists, is_folder, write_file
from orthocal.robot.model import Robot
from orthocal.statistics.identifiability import Identifiability
from orthocal.text import shorten

Array = NDArray[np.float64]

SCHEMA = "orthocal/calibration/7"

FOLLOWS = 1e-9
"""Relative difference up to which a number is what it follows from: both are sums of doubles."""

BESIDE = ("schema", "decision", "findings")
"""What is no part of the record: its schema, and what `calibrate --json` prints beside it."""

MAKE_ONE = "`orthocal calibrate SESSION --out FOLDER` makes one"

OTHER_KINDS = (".csv", ".html", ".urdf", ".yaml", ".yml")
"""What the names of files of other kinds end with."""


def load_calibration(path: str | Path) -> Calibration:
    """Read a calibration.json, or the one in a folder.

    Raises:
        CalibrationFileError: Naming file and key, what was found and what was expected.
    """
    file = Path(path)
    if is_folder(file):
        file = file / "calibration.json"
    if not exists(file):
        raise CalibrationFileError(f"there is no such file; {MAKE_ONE}", where=str(file))
    if file.suffix.lower() in OTHER_KINDS:
        raise CalibrationFileError(f"is no calibration.json; {MAKE_ONE}", where=str(file))
    data = read_json(file, error=CalibrationFileError)
    if isinstance(data, Mapping) and "schema" not in data:
        raise CalibrationFileError(f"is missing; expected '{SCHEMA}'", where=f"{file}: schema")
    if isinstance(data, Mapping) and data["schema"] != SCHEMA:
        raise CalibrationFileError(
            f"schema is '{data.get('schema')}'; expected '{SCHEMA}'", where=str(file)
        )
    return _read_document(data, str(file), path=file)


def calibration_document(calibration: Calibration) -> dict[str, Any]:
    """A calibration as plain data: the content of calibration.json."""
    document = {"schema": SCHEMA, **write_plain(calibration, CalibrationRecord)}
    for (key, index, name), value in _derive(calibration):
        part: Any = document[key] if key else document
        (part if index is None else part[index])[name] = value
    return document


def calibration_json(calibration: Calibration) -> str:
    """A calibration as the text of calibration.json."""
    return json.dumps(calibration_document(calibration), indent=1, allow_nan=False) + "\n"


def write_calibration(calibration: Calibration, path: str | Path) -> Path:
    """Write a calibration.json.

    Raises:
        OrthocalError: If it cannot be written.
    """
    write_file(Path(path), calibration_json(calibration))
    return Path(path)


def require_loadable(calibration: Calibration) -> None:
    """Refuse a result that could not be read again once it is written: it makes no sense.

    Raises:
        SolverError: Naming the number that cannot be.
    """
    try:
        _read_document(
            calibration_document(calibration), "calibration.json", robot=calibration.robot
        )
    except CalibrationFileError as e:
        raise SolverError(
            f"the result makes no sense ({e}); look for readings, a σ, tolerances or bounds that "
            "cannot be",
            status="absurd result",
            iterations=calibration.solver.iterations,
        ) from None


def _read_document(
    data: Any,  # noqa: ANN401 - any document
    file: str,
    *,
    path: Path | None = None,
    robot: Robot | None = None,
) -> Calibration:
    """A document as a calibration, each of its parts checked against the others.

    Args:
        data: The document; what does not belong to the record is taken out of it.
        file: Where it is from, for messages.
        path: The file, where it is from one.
        robot: The robot that it is of; by default that which the document names.

    Raises:
        CalibrationFileError: Naming the key.
    """
    derived = _take_derived(data)
    record = validate(CalibrationRecord, data, where=file, error=CalibrationFileError)
    count = sum(p.free for p in record.parameters)
    if not count:
        raise CalibrationFileError("holds none that is free", where=f"{file}: parameters")
    for key in ("model_covariance", "noise_covariance"):
        _require_covariance(getattr(record, key), count, f"{file}: {key}")
    _check_unmodelled(record, file)
    _check_estimates(record, file)
    _check_singular_values(record.identifiability, file)
    known = load_recorded_robot(record.robot_record, file=file) if robot is None else robot
    prefix = "" if path is None else f"{path}: "
    require_parameters(known, record.parameters, record.unmodelled.names, prefix=prefix)
    require_rows(known, record.setups, record.postures, record.residuals, prefix=prefix)
    require_offsets(known, record.session.controller_offsets, prefix=prefix)
    calibration = Calibration(
        **{name: getattr(record, name) for name in CalibrationRecord.__slots__},
        robot=known,
        path=path,
    )
    for place, value in _derive(calibration):
        if place in derived:
            _check_derived(place, derived[place], value, file)
    return calibration


_Place = tuple[str, int | None, str]
"""Key of the document, index in it, name: of one number that follows; "" for the document."""


def _derive(c: Calibration) -> Iterator[tuple[_Place, Any]]:
    """Numbers that follow from a record, and where they stand."""
    yield ("", None, "sigma"), finite_or_none(c.sigma)
    yield ("", None, "dof"), finite_or_none(c.dof)
    for name in ("rms_before", "rms_after", "largest_before", "largest_after"):
        yield ("", None, name), getattr(c, name)
    yield ("identifiability", None, "condition"), finite_or_none(c.identifiability.condition)
    yield ("identifiability", None, "observability"), c.identifiability.observability
    for i, row in enumerate(c.residuals):
        yield ("residuals", i, "residual"), row.residual


_FOLLOWING = {
    "": ("sigma", "dof", "rms_before", "rms_after", "largest_before", "largest_after", *BESIDE),
    "identifiability": ("condition", "observability"),
    "residuals": ("residual",),
}
"""Names of such numbers, and of what is not read, by their key."""


def _take_derived(data: Any) -> dict[_Place, Any]:  # noqa: ANN401 - any document
    """Metadata of the numbers that follow, removed from the document."""
    found: dict[_Place, Any] = {}
    for key, names in _FOLLOWING.items():
        part = data.get(key) if key and isinstance(data, dict) else data
        holders = enumerate(part) if isinstance(part, list) else [(None, part)]
        for i, holder in holders:
            if isinstance(holder, dict):
                found |= {(key, i, n): holder.pop(n) for n in names if n in holder}
    return found


def _check_derived(
    place: _Place,
    found: Any,  # noqa: ANN401 - whatever stood there
    value: float | dict[str, float] | None,
    file: str,
) -> None:
    """Refuse a number, or numbers by name, that are not what they follow from."""
    if isinstance(value, dict):
        inner = found if isinstance(found, dict) else {}
        for name, number in value.items():
            where = (place[0], place[1], f"{place[2]}.{name}")
            _check_derived(where, inner.get(name), number, file)
        return
    if found is None and value is None:
        return
    number = isinstance(found, int | float) and not isinstance(found, bool)
    if number and value is not None and math.isclose(found, value, rel_tol=FOLLOWS, abs_tol=1e-15):
        return
    key, index, name = place
    at = "" if not key else f"{key}." if index is None else f"{key}[{index}]."
    expected = "null" if value is None else f"{value:.9g}"
    shown = "null" if found is None else shorten(str(found))
    raise CalibrationFileError(
        f"found {shown}; by what the file says otherwise it is {expected}",
        where=f"{file}: {at}{name}",
    )


def _check_estimates(record: CalibrationRecord, file: str) -> None:
    """Refuse parameters and covariances that do not belong to each other."""
    free = [(i, p) for i, p in enumerate(record.parameters) if p.free]
    names = [p.name for p in record.parameters]
    for i, name in enumerate(names):
        if name in names[:i]:
            raise CalibrationFileError(
                f"'{name}' stands twice", where=f"{file}: parameters[{i}].name"
            )
    variances = {
        key: np.diag(getattr(record, key)) for key in ("model_covariance", "noise_covariance")
    }
    bias = np.diag(record.unmodelled.bias_covariance)
    for key, variance in (
        ("std", variances["model_covariance"] + bias),
        ("std_scatter", variances["noise_covariance"]),
    ):
        for (i, p), size in zip(free, np.sqrt(np.abs(variance)).tolist(), strict=True):
            if math.isfinite(size):
                _check_derived(("parameters", i, key), getattr(p, key), size, file)


def _require_covariance(matrix: Array, count: int, where: str) -> None:
    """Refuse numbers that are no covariance of the free parameters."""
    if matrix.shape != (count, count):
        raise CalibrationFileError(
            f"expected {count} × {count} numbers, as free parameters", where=where
        )
    if not np.isfinite(matrix).all():
        return
    scale = float(np.abs(matrix).max())
    std = np.sqrt(np.abs(np.diag(matrix)))
    unit = matrix / np.outer(*(np.where(std > 0.0, std, 1.0),) * 2)
    symmetric = np.abs(matrix - matrix.T).max() <= FOLLOWS * scale
    if not symmetric or np.linalg.eigvalsh(unit).min() < -1e-6:
        raise CalibrationFileError(
            "is not a covariance: expected symmetric numbers without negative variances",
            where=where,
        )


def _check_singular_values(found: Identifiability, file: str) -> None:
    """Refuse singular values that are none, or that count though they are 0."""
    values = found.singular_values
    if not values.size or values.min() < 0.0 or (np.diff(values) > 0.0).any():
        raise CalibrationFileError(
            "expected positive numbers, the largest first",
            where=f"{file}: identifiability.singular_values",
        )
    if found.rank > len(values) or (found.rank and values[found.rank - 1] <= 0.0):
        raise CalibrationFileError(
            f"found {found.rank}; only {(values > 0.0).sum()} singular values are above 0",
            where=f"{file}: identifiability.rank",
        )


def _check_unmodelled(record: CalibrationRecord, file: str) -> None:
    found, n_free = record.unmodelled, len(record.model_covariance)
    count = len(found.names)
    if found.prior_stds.shape != (count,):
        raise CalibrationFileError(
            f"has {found.prior_stds.size} numbers; expected {count}, as names",
            where=f"{file}: unmodelled.prior_stds",
        )
    if found.leakage.shape != (n_free, count):
        raise CalibrationFileError(
            f"expected {n_free} × {count} numbers, free parameters by names",
            where=f"{file}: unmodelled.leakage",
        )
