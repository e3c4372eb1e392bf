"""Reading, checking and writing of calibration.json.

The record (`records.py`) is the schema. The file also contains numbers derived from the record, for
readers without orthocal. Loading recomputes and compares them.
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
from orthocal.calibration.recorded_robot import load_recorded_robot, require_consistent
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
"""Largest relative difference of a derived number from its recomputed value."""

BESIDE = ("schema", "decision", "findings")
"""Keys outside the record: the schema, and further keys of `calibrate --json`."""

MAKE_ONE = "`orthocal calibrate SESSION --out FOLDER` makes one"

OTHER_KINDS = (".csv", ".html", ".urdf", ".yaml", ".yml")
"""Suffixes of files of other kinds."""


def load_calibration(path: str | Path) -> Calibration:
    """Read a calibration.json, or the one in a directory. It needs no other file.

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
    """Refuse a result that could not be loaded from its file.

    Raises:
        SolverError: Naming the impossible number.
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
    """Calibration of a document, whose parts are checked against each other.

    Args:
        data: The document; derived numbers are removed from it.
        file: Name of the file, for messages.
        path: The file, if the document was read from one.
        robot: The calibrated robot; by default the embedded one.

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
    if robot is None:
        robot = load_recorded_robot(record.robot_record, file=file)
    require_consistent(record, robot, file=file)
    calibration = Calibration(
        **{name: getattr(record, name) for name in CalibrationRecord.__slots__},
        robot=robot,
        path=path,
    )
    for place, value in _derive(calibration):
        if place in derived:
            _check_derived(place, derived[place], value, file)
    return calibration


_Place = tuple[str, int | None, str]
"""Key in the document ("" for the document), index in a list, and name of a derived number."""


def _derive(c: Calibration) -> Iterator[tuple[_Place, Any]]:
    """Derived numbers of a record, with their places in the document."""
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
"""Names of derived numbers and of keys that are not read, by the key that contains them."""


def _take_derived(data: Any) -> dict[_Place, Any]:  # noqa: ANN401 - any document
    """Derived numbers of a document, which are removed from it."""
    derived: dict[_Place, Any] = {}
    for key, names in _FOLLOWING.items():
        part = data.get(key) if key and isinstance(data, dict) else data
        holders = enumerate(part) if isinstance(part, list) else [(None, part)]
        for i, holder in holders:
            if isinstance(holder, dict):
                derived |= {(key, i, n): holder.pop(n) for n in names if n in holder}
    return derived


def _check_derived(
    place: _Place,
    stated: Any,  # noqa: ANN401 - any value of a document
    value: float | dict[str, float] | None,
    file: str,
) -> None:
    """Refuse a stated number, or numbers by name, that differ from the recomputed ones."""
    if isinstance(value, dict):
        inner = stated if isinstance(stated, dict) else {}
        for name, number in value.items():
            where = (place[0], place[1], f"{place[2]}.{name}")
            _check_derived(where, inner.get(name), number, file)
        return
    if stated is None and value is None:
        return
    number = isinstance(stated, int | float) and not isinstance(stated, bool)
    if number and value is not None and math.isclose(stated, value, rel_tol=FOLLOWS, abs_tol=1e-15):
        return
    key, index, name = place
    at = "" if not key else f"{key}." if index is None else f"{key}[{index}]."
    expected = "null" if value is None else f"{value:.9g}"
    shown = "null" if stated is None else shorten(str(stated))
    raise CalibrationFileError(
        f"found {shown}; by what the file says otherwise it is {expected}",
        where=f"{file}: {at}{name}",
    )


def _check_estimates(record: CalibrationRecord, file: str) -> None:
    """Refuse parameters whose standard deviations contradict the covariances."""
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
    """Refuse a matrix that is not a covariance of the free parameters."""
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


def _check_singular_values(identifiability: Identifiability, file: str) -> None:
    """Refuse negative or unsorted singular values, and a rank above their number."""
    values, rank = identifiability.singular_values, identifiability.rank
    if not values.size or values.min() < 0.0 or (np.diff(values) > 0.0).any():
        raise CalibrationFileError(
            "expected positive numbers, the largest first",
            where=f"{file}: identifiability.singular_values",
        )
    if rank > len(values) or (rank and values[rank - 1] <= 0.0):
        raise CalibrationFileError(
            f"found {rank}; only {(values > 0.0).sum()} singular values are above 0",
            where=f"{file}: identifiability.rank",
        )


def _check_unmodelled(record: CalibrationRecord, file: str) -> None:
    unmodelled, n_free = record.unmodelled, len(record.model_covariance)
    count = len(unmodelled.names)
    if unmodelled.prior_stds.shape != (count,):
        raise CalibrationFileError(
            f"has {unmodelled.prior_stds.size} numbers; expected {count}, as names",
            where=f"{file}: unmodelled.prior_stds",
        )
    if unmodelled.leakage.shape != (n_free, count):
        raise CalibrationFileError(
            f"expected {n_free} × {count} numbers, free parameters by names",
            where=f"{file}: unmodelled.leakage",
        )
