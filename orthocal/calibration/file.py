"""Reading, checking and writing of calibration.json.

The record (`records.py`) is the schema. The file also contains numbers that are derived from the
record, for use without orthocal. Loading recomputes and compares them.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np

from orthocal.arrays import Array
from orthocal.calibration.build_record import absurd_result
from orthocal.calibration.calibration import Calibration
from orthocal.calibration.recorded_robot import load_recorded_robot, require_consistent
from orthocal.calibration.records import CalibrationRecord
from orthocal.calibration.refit import restore_session
from orthocal.errors import CalibrationFileError
from orthocal.io.documents import format_json, read_json, validate, write_plain
from orthocal.io.fields import finite_or_none
from orthocal.io.files import exists, is_folder, require_suffix, write_file
from orthocal.observation.sensor_groups import nuisance_parameters
from orthocal.robot.model import Robot
from orthocal.text import shorten

SCHEMA = "orthocal/calibration/18"

DERIVED_TOLERANCE = 1e-9
"""Largest relative difference of a derived number from its recomputed value."""

NEGLIGIBLE = 1e-15
"""Largest absolute difference of a derived number, [SI], for numbers near 0."""

SMALLEST_EIGENVALUE = -1e-6
"""Smallest eigenvalue of a correlation matrix; rounding errors of a singular one are above it."""

OTHER_KEYS = ("schema", "decision", "findings")
"""Keys outside the record: the schema, and keys of `calibrate --json`."""

CREATE_HINT = "`orthocal calibrate SESSION --out DIRECTORY` makes one"

OTHER_KINDS = (".csv", ".html", ".urdf", ".yaml", ".yml")
"""Suffixes of files that are no calibration."""


def load_calibration(path: str | Path) -> Calibration:
    """Read a calibration.json, or the one in a directory. No other file is needed.

    Raises:
        CalibrationFileError: If the file is missing or invalid; names file and key.
    """
    file = Path(path)
    if is_folder(file):
        if exists(file / "session.yaml") and not exists(file / "calibration.json"):
            raise CalibrationFileError(
                f"is a session, no calibration; {CREATE_HINT}", where=str(file)
            )
        file = file / "calibration.json"
    if not exists(file):
        raise CalibrationFileError(f"there is no such file; {CREATE_HINT}", where=str(file))
    if file.suffix.lower() in OTHER_KINDS:
        raise CalibrationFileError(f"is no calibration.json; {CREATE_HINT}", where=str(file))
    data = read_json(file, error=CalibrationFileError)
    if isinstance(data, Mapping) and "schema" not in data:
        raise CalibrationFileError(f"is missing; expected '{SCHEMA}'", where=f"{file}: schema")
    if isinstance(data, Mapping) and data["schema"] != SCHEMA:
        raise CalibrationFileError(
            f"found '{shorten(str(data['schema']))}'; expected '{SCHEMA}'", where=f"{file}: schema"
        )
    return _read_document(data, str(file), path=file)


def calibration_document(calibration: Calibration) -> dict[str, Any]:
    """Calibration as plain data: the content of calibration.json."""
    derived = _derive(calibration)
    document = {"schema": SCHEMA, **write_plain(calibration, CalibrationRecord)}
    document["identifiability"] |= derived.pop("identifiability")
    for row, derived_of_row in zip(document["residuals"], derived.pop("residuals"), strict=True):
        row |= derived_of_row
    return document | derived


def calibration_json(calibration: Calibration) -> str:
    """Calibration as the text of calibration.json.

    Raises:
        SolverError: If it could not be loaded again; names the impossible number.
    """
    document = calibration_document(calibration)
    try:
        _read_document(document, "calibration.json", robot=calibration.robot)
    except CalibrationFileError as e:
        raise absurd_result(str(e), calibration.solver.iterations) from None
    return format_json(document)


def write_calibration(calibration: Calibration, path: str | Path) -> Path:
    """Write a calibration.json.

    Raises:
        OrthocalError: If it cannot be written, or if the name is that of another kind of file.
    """
    file = Path(path)
    require_suffix(file, ".json", OTHER_KINDS)
    write_file(file, calibration_json(calibration))
    return file


def _read_document(
    data: Any,  # noqa: ANN401 - any document
    file: str,
    *,
    path: Path | None = None,
    robot: Robot | None = None,
) -> Calibration:
    """Calibration of a document after checks for contradictions.

    Args:
        data: The document.
        file: File name, for messages.
        path: Path to the file, if the document was read from one.
        robot: The calibrated robot; by default the embedded one.

    Raises:
        CalibrationFileError: If the document is invalid or contradictory; names the key.
    """
    plain = _without(data, (*_DERIVED, *OTHER_KEYS))
    for key, names in _DERIVED_IN.items():
        if isinstance(plain, dict) and key in plain:
            plain[key] = _without(plain[key], names)
    record = validate(CalibrationRecord, plain, where=file, error=CalibrationFileError)
    contradiction = next(_find_contradictions(record), None)
    if contradiction is not None:
        key, problem = contradiction
        raise CalibrationFileError(problem, where=f"{file}: {key}")
    if robot is None:
        robot = load_recorded_robot(record.robot_record, file=file)
    require_consistent(record, robot, file=file)
    calibration = Calibration(
        **{name: getattr(record, name) for name in CalibrationRecord.__slots__},
        robot=robot,
        path=path,
    )
    _check_sensors(calibration, file)
    _check_estimates(calibration, file)
    _check_derived(data, _derive(calibration), file)
    return calibration


_DERIVED = ("sigma", "dof", "rms_before", "rms_after", "largest_before", "largest_after")
"""Names of derived numbers of the document."""

_DERIVED_IN = {"identifiability": ("condition", "observability"), "residuals": ("residual",)}
"""Names of derived numbers in parts of the document."""


def _derive(c: Calibration) -> dict[str, Any]:
    """Derived numbers of a calibration, by their keys in the document."""
    return {
        **{name: finite_or_none(getattr(c, name)) for name in _DERIVED},
        "identifiability": {
            "condition": finite_or_none(c.identifiability.condition),
            "observability": c.identifiability.observability,
        },
        "residuals": [{"residual": row.residual} for row in c.residuals],
    }


def _without(part: Any, names: Collection[str]) -> Any:  # noqa: ANN401 - any document
    """Part of a document, or list of parts, without some keys."""
    if isinstance(part, list):
        return [_without(p, names) for p in part]
    return {k: v for k, v in part.items() if k not in names} if isinstance(part, dict) else part


def _check_derived(
    stated: Any,  # noqa: ANN401 - any document
    expected: Any,  # noqa: ANN401 - a derived number, or parts with some
    file: str,
    key: str = "",
) -> None:
    """Refuse stated numbers that differ from the recomputed ones; missing numbers are accepted."""
    if isinstance(expected, dict):
        if not isinstance(stated, dict):
            raise CalibrationFileError(
                f"found {shorten(str(stated))}; expected keys and values", where=f"{file}: {key}"
            )
        for name in [name for name in expected if name in stated]:
            inner_key = f"{key}.{name}" if key else name
            _check_derived(stated[name], expected[name], file, inner_key)
        return
    if isinstance(expected, list):
        for i, pair in enumerate(zip(stated, expected, strict=True)):
            _check_derived(*pair, file, f"{key}[{i}]")
        return
    is_number = isinstance(stated, int | float) and not isinstance(stated, bool)
    if stated is None or expected is None:
        agrees = stated is expected
    else:
        agrees = is_number and math.isclose(
            stated, expected, rel_tol=DERIVED_TOLERANCE, abs_tol=NEGLIGIBLE
        )
    if not agrees:
        stated_text = "null" if stated is None else shorten(str(stated))
        expected_text = "null" if expected is None else f"{expected:.9g}"
        raise CalibrationFileError(
            f"found {stated_text}; the other numbers of the file give {expected_text}",
            where=f"{file}: {key}",
        )


def _check_sensors(calibration: Calibration, file: str) -> None:
    """Refuse nuisance parameters other than those of the setups."""
    expected = [
        (p.name, p.unit) for p in nuisance_parameters(restore_session(calibration)).parameters
    ]
    for i, (p, of_setups) in enumerate(zip_longest(calibration.sensors, expected)):
        if p is None or (p.name, p.unit) != of_setups:
            found = "nothing" if p is None else f"'{shorten(p.name)}' in {p.unit}"
            wanted = "nothing" if of_setups is None else f"'{of_setups[0]}' in {of_setups[1]}"
            raise CalibrationFileError(
                f"found {found}; the setups have {wanted}", where=f"{file}: sensors[{i}]"
            )


def _check_estimates(calibration: Calibration, file: str) -> None:
    """Refuse standard deviations that contradict the covariances."""
    n = len(calibration.free)
    keys = ("std", "std_scatter", "std_scaled")
    free = [(i, p) for i, p in enumerate(calibration.parameters) if p.free]
    for key, covariance in zip(keys, calibration.error_covariances, strict=True):
        variances = np.diag(covariance)[:n]  # unmodelled errors follow
        # rounding errors may make a variance of 0 negative
        for (i, p), size in zip(free, np.sqrt(np.abs(variances)).tolist(), strict=True):
            stated, expected = finite_or_none(getattr(p, key)), finite_or_none(size)
            _check_derived(stated, expected, file, f"parameters[{i}].{key}")


def _find_contradictions(record: CalibrationRecord) -> Iterator[tuple[str, str]]:
    """Keys that contradict other parts of a record, with the problem."""
    n_free = sum(p.free for p in record.parameters)
    if not n_free:
        yield "parameters", "contains no free parameter"
    for key in ("model_covariance", "noise_covariance", "scaled_covariance"):
        matrix = getattr(record, key)
        if matrix.shape != (n_free, n_free):
            yield key, f"expected {n_free} × {n_free} numbers, one row per free parameter"
        if not _is_covariance(matrix):
            yield (
                key,
                "is not a covariance: expected symmetric numbers without negative variances",
            )
    unmodelled, n_unmodelled = record.unmodelled, len(record.unmodelled.names)
    if unmodelled.prior_stds.shape != (n_unmodelled,):
        size = unmodelled.prior_stds.size
        yield "unmodelled.prior_stds", f"has {size} numbers; expected {n_unmodelled}, one per name"
    if unmodelled.leakage.shape != (n_free, n_unmodelled):
        expected = f"expected {n_free} × {n_unmodelled} numbers, free parameters × names"
        yield "unmodelled.leakage", expected
    for key in ("parameters", "sensors", "postures", "setups", "gauges"):
        names = [part.name for part in getattr(record, key)]
        for i, name in enumerate(names):
            if name in names[:i]:
                yield f"{key}[{i}].name", f"'{name}' occurs twice"
    for i, gauge in enumerate(record.gauges):
        if gauge.range is not None and not gauge.range[0] < gauge.range[1]:
            yield f"gauges[{i}].range", "expected the lowest reading, then the highest"
    values, rank = record.identifiability.singular_values, record.identifiability.rank
    if not values.size or values.min() < 0.0 or (np.diff(values) > 0.0).any():
        yield "identifiability.singular_values", "expected numbers of at least 0, the largest first"
    if rank > len(values) or (rank and values[rank - 1] <= 0.0):
        positive = (values > 0.0).sum()
        yield "identifiability.rank", f"found {rank}; only {positive} singular values are above 0"


def _is_covariance(matrix: Array) -> bool:
    """True for symmetric numbers without negative variances, and for NaN only: unknown."""
    if not np.isfinite(matrix).all():
        return bool(np.isnan(matrix).all())
    std = np.sqrt(np.abs(np.diag(matrix)))  # a negative variance stays one in the correlation
    scale = np.where(std > 0.0, std, 1.0)
    correlation = matrix / np.outer(scale, scale)
    symmetric = np.abs(matrix - matrix.T).max() <= DERIVED_TOLERANCE * np.abs(matrix).max()
    return bool(symmetric and np.linalg.eigvalsh(correlation).min() >= SMALLEST_EIGENVALUE)
