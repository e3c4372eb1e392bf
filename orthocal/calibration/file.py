"""calibration.json read and checked: it may come from a stranger, or from an editor."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from orthocal.calibration.calibration import SCHEMA, Calibration
from orthocal.calibration.records import (
    GaugeRecord,
    NoiseRecord,
    ParameterEstimate,
    PostureRecord,
    RobotRecord,
    SessionRecord,
    SetupRecord,
    SolverRecord,
)
from orthocal.diagnosis.rows import ResidualRow
from orthocal.diagnosis.turned import TurnedSetup
from orthocal.diagnosis.unmodelled import Unmodelled
from orthocal.documents import Count, Finite, Number, PositiveInSI, read_json, validate
from orthocal.errors import CalibrationFileError, SolverError
from orthocal.files import exists, is_folder
from orthocal.robot.model import read_only
from orthocal.sensors.registry import read_setup
from orthocal.statistics.identifiability import Combination, Identifiability

Array = NDArray[np.float64]


class _Keys(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


Item = TypeVar("Item")
Many = Annotated[list[Item], Field(fail_fast=True)]
"""A list of which one wrong item is told, however many there are."""

Terms = Annotated[Many[tuple[str, Number]], Field(min_length=1)]


class _RobotKeys(_Keys):
    name: str
    reference: str
    folder: str | None
    sha256: str
    legs: Many[tuple[str, PositiveInSI]]
    travel: Many[tuple[str, Literal["m", "rad"], Number | None, Number | None]]


class _PartKeys(_Keys):
    path: str | None
    readings_path: str | None
    title: str
    source: str
    sha256: str
    gauge_sigma: PositiveInSI | None
    gauge_resolution: PositiveInSI | None
    controller_offsets: Many[Number] | None


class _SessionKeys(_PartKeys):
    parts: Many[_PartKeys]


class _SolverKeys(_Keys):
    name: Literal["ipopt", "eliminated", "linearised"]
    status: str
    iterations: Count
    seconds_build: Number
    seconds_solve: Number
    hessian: str
    loss: Literal["squares", "huber"]
    loss_width: PositiveInSI


class _ParameterKeys(_Keys):
    name: str
    unit: Literal["m", "rad", "1"]
    value: Number
    linear: Number
    std: Annotated[Number, Field(ge=0.0)] | None
    tolerance: PositiveInSI
    free: bool
    identifiable: bool
    start: Number
    prior: bool
    mean: Number
    lower: Number | None
    upper: Number | None
    at_bound: Literal["lower", "upper"] | None
    interval: tuple[Number, Number] | None


class _NoiseKeys(_Keys):
    reading_sigma: Annotated[Number, Field(ge=0.0)] | None
    source: Literal["cycles", "residuals", "gauge", "unknown"]
    cycles_sigma: Annotated[Number, Field(ge=0.0)] | None
    cycles_dof: Count
    residual_sigma: Annotated[Number, Field(ge=0.0)] | None
    residual_dof: Annotated[Number, Field(ge=0.0)]


class _ResidualKeys(_Keys):
    setup: str
    posture: str
    minus: Annotated[str, Field(min_length=1)] | None
    cycle: Count
    measured: Number
    nominal: Number
    linear: Number | None
    predicted: Number
    line: Count | None
    file: str | None
    studentised: Number | None
    influence: Number
    influenced: str
    unseen: Number | None
    residual: Number


class _PostureKeys(_Keys):
    name: str
    drives: Many[Number]
    passive: Many[Number]


class _SetupKeys(_Keys):
    name: str
    reads: dict[str, Any]
    zero: Number | None


class _GaugeKeys(_Keys):
    name: str
    sigma: PositiveInSI | None
    resolution: PositiveInSI | None
    noise: Annotated[Number, Field(ge=0.0)] | None
    readings: Count


class _TurnedKeys(_Keys):
    name: str
    as_read: Number | None
    turned: Number | None
    also: list[str] = []
    evidence: Number


class _UnmodelledKeys(_Keys):
    names: Many[str]
    tolerances: Many[PositiveInSI]
    leakage: Many[Many[Number]]
    residual_rms: Number


class _ObservabilityKeys(_Keys):
    O1: Number
    O2: Number
    O3: Number
    O4: Number
    O5: Number


class _IdentifiabilityKeys(_Keys):
    singular_values: Annotated[Many[Number], Field(min_length=1)]
    threshold: Number
    rank: Count
    structural_rank: Count
    condition: Finite | None
    observability: _ObservabilityKeys
    n_postures: Annotated[Count, Field(ge=1)]
    n_readings: Count
    unseen: Many[str]
    told: Many[str]
    alike: Many[Terms]
    base: Many[Terms]


class _CalibrationKeys(_Keys):
    schema_: Annotated[Literal["orthocal/calibration/3"], Field(alias="schema")]
    orthocal: str
    robot: _RobotKeys
    session: _SessionKeys
    model: str
    prior: bool
    solver: _SolverKeys
    parameters: Annotated[Many[_ParameterKeys], Field(min_length=1)]
    sensors: Many[_ParameterKeys]
    covariance: Many[Many[Number | None]]
    unmodelled: _UnmodelledKeys
    identifiability: _IdentifiabilityKeys
    base: bool
    sigma: Annotated[Number, Field(ge=0.0)] | None
    dof: Annotated[Number, Field(ge=0.0)] | None
    noise: _NoiseKeys
    rows_are_differences: bool
    rms_before: Number
    rms_after: Number
    largest_before: Number
    largest_after: Number
    critical: Number | None
    residuals: Many[_ResidualKeys]
    turned: _TurnedKeys | None
    postures: Many[_PostureKeys]
    setups: Many[_SetupKeys]
    gauges: Many[_GaugeKeys]
    decision: Any = None
    """As `calibrate --json` prints it beside the rest: not read, it follows from that."""
    findings: Any = None
    """Likewise."""


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
    keys = _check_document(data, str(file))
    free = [p for p in keys.parameters if p.free]
    covariance = _covariance(keys)
    return Calibration(
        robot_record=RobotRecord(
            **{
                **keys.robot.model_dump(),
                "legs": tuple(keys.robot.legs),
                "travel": tuple(keys.robot.travel),
            }
        ),
        session=_session(keys.session, tuple(_session(p) for p in keys.session.parts)),
        model=keys.model,
        prior=keys.prior,
        solver=SolverRecord(**keys.solver.model_dump()),
        parameters=tuple(
            ParameterEstimate(**{**p.model_dump(), "std": _float(p.std)}) for p in keys.parameters
        ),
        sensors=tuple(
            ParameterEstimate(**{**p.model_dump(), "std": _float(p.std)}) for p in keys.sensors
        ),
        covariance=read_only(covariance),
        noise=NoiseRecord(
            reading_sigma=_float(keys.noise.reading_sigma),
            source=keys.noise.source,
            cycles_sigma=_float(keys.noise.cycles_sigma),
            cycles_dof=keys.noise.cycles_dof,
            residual_sigma=_float(keys.noise.residual_sigma),
            residual_dof=keys.noise.residual_dof,
        ),
        sigma=_float(keys.sigma),
        dof=math.inf if keys.dof is None else keys.dof,
        rows_are_differences=keys.rows_are_differences,
        unmodelled=Unmodelled(
            names=tuple(keys.unmodelled.names),
            tolerances=read_only(keys.unmodelled.tolerances),
            leakage=read_only(np.array(keys.unmodelled.leakage).reshape(len(free), -1)),
            residual_rms=keys.unmodelled.residual_rms,
        ),
        identifiability=_identifiability(keys.identifiability),
        base=keys.base,
        residuals=tuple(_residual(r) for r in keys.residuals),
        turned=None if keys.turned is None else _turned(keys.turned),
        critical=math.inf if keys.critical is None else keys.critical,
        postures=tuple(
            PostureRecord(p.name, tuple(p.drives), tuple(p.passive)) for p in keys.postures
        ),
        setups=_setups(keys, str(file)),
        gauges=tuple(
            GaugeRecord(**{**g.model_dump(), "noise": _float(g.noise)}) for g in keys.gauges
        ),
        version=keys.orthocal,
        path=file,
    )


def require_loadable(calibration: Calibration) -> None:
    """Refuse a result that could not be read again once it is written: it makes no sense.

    Raises:
        SolverError: Naming the number that cannot be.
    """
    try:
        _check_document(calibration.to_document(), "calibration.json")
    except CalibrationFileError as e:
        raise SolverError(
            f"the result makes no sense ({e}); look for readings, a σ, tolerances or bounds that "
            "cannot be",
            status="absurd result",
            iterations=calibration.solver.iterations,
        ) from None


def _check_document(data: Any, file: str) -> _CalibrationKeys:  # noqa: ANN401 - any document
    """The keys of a calibration.json, held against each other.

    Args:
        data: The document.
        file: Where it is from, for messages.

    Raises:
        CalibrationFileError: Naming the key.
    """
    keys = validate(_CalibrationKeys, data, where=file, error=CalibrationFileError)
    n_free = sum(p.free for p in keys.parameters)
    if not n_free:
        raise CalibrationFileError("holds none that is free", where=f"{file}: parameters")
    if len(keys.covariance) != n_free or any(len(row) != n_free for row in keys.covariance):
        raise CalibrationFileError(
            f"expected {n_free} × {n_free} numbers, as free parameters",
            where=f"{file}: covariance",
        )
    _check_covariance(_covariance(keys), file)
    _check_unmodelled(keys.unmodelled, n_free, file)
    seen: set[str] = set()
    for i, p in enumerate(keys.parameters):
        if p.name in seen:
            raise CalibrationFileError(
                f"'{p.name}' stands twice", where=f"{file}: parameters[{i}].name"
            )
        seen.add(p.name)
    _check_singular_values(keys.identifiability, file)
    if not keys.residuals:
        raise CalibrationFileError("is empty", where=f"{file}: residuals")
    return keys


def _covariance(keys: _CalibrationKeys) -> Array:
    """Covariance with NaN for what is not known, shape (n_free, n_free)."""
    return np.array([[_float(v) for v in row] for row in keys.covariance], dtype=np.float64)


def _check_covariance(covariance: Array, file: str) -> None:
    """Refuse what cannot be a covariance: a file can be edited."""
    if not np.isfinite(covariance).all():
        return
    scale = float(np.abs(covariance).max())
    std = np.sqrt(np.abs(np.diag(covariance)))
    unit = covariance / np.outer(*(np.where(std > 0.0, std, 1.0),) * 2)
    symmetric = np.abs(covariance - covariance.T).max() <= 1e-9 * scale
    if not symmetric or np.linalg.eigvalsh(unit).min() < -1e-6:
        raise CalibrationFileError(
            "is not a covariance: expected symmetric numbers without negative variances",
            where=f"{file}: covariance",
        )


def _check_singular_values(keys: _IdentifiabilityKeys, file: str) -> None:
    """Refuse singular values that are none, or that count though they are 0."""
    values = keys.singular_values
    if min(values) < 0.0 or sorted(values, reverse=True) != values:
        raise CalibrationFileError(
            "expected positive numbers, the largest first",
            where=f"{file}: identifiability.singular_values",
        )
    if keys.rank > len(values) or (keys.rank and values[keys.rank - 1] <= 0.0):
        raise CalibrationFileError(
            f"found {keys.rank}; only {sum(v > 0.0 for v in values)} singular values are above 0",
            where=f"{file}: identifiability.rank",
        )


def _check_unmodelled(keys: _UnmodelledKeys, n_free: int, file: str) -> None:
    count = len(keys.names)
    if len(keys.tolerances) != count:
        raise CalibrationFileError(
            f"has {len(keys.tolerances)} numbers; expected {count}, as names",
            where=f"{file}: unmodelled.tolerances",
        )
    if len(keys.leakage) != n_free or any(len(row) != count for row in keys.leakage):
        raise CalibrationFileError(
            f"expected {n_free} × {count} numbers, free parameters by names",
            where=f"{file}: unmodelled.leakage",
        )


def _identifiability(keys: _IdentifiabilityKeys) -> Identifiability:
    return Identifiability(
        singular_values=read_only(keys.singular_values),
        threshold=keys.threshold,
        rank=keys.rank,
        structural_rank=keys.structural_rank,
        n_postures=keys.n_postures,
        n_readings=keys.n_readings,
        unseen=tuple(keys.unseen),
        told=tuple(keys.told),
        alike=tuple(Combination(tuple(terms)) for terms in keys.alike),
        base=tuple(Combination(tuple(terms)) for terms in keys.base),
    )


def _residual(keys: _ResidualKeys) -> ResidualRow:
    values = keys.model_dump(exclude={"residual"})
    for name in ("linear", "studentised", "unseen"):
        values[name] = _float(values[name])
    return ResidualRow(**values)


def _session(keys: _PartKeys, parts: tuple[SessionRecord, ...] = ()) -> SessionRecord:
    offsets = keys.controller_offsets
    values = keys.model_dump(exclude={"parts"})
    values["controller_offsets"] = None if offsets is None else tuple(offsets)
    return SessionRecord(**values, parts=parts)


def _setups(keys: _CalibrationKeys, file: str) -> tuple[SetupRecord, ...]:
    found = []
    for i, setup in enumerate(keys.setups):
        _, sensor = read_setup(
            setup.reads, where=file, under=f"setups[{i}].reads", error=CalibrationFileError
        )
        found.append(SetupRecord(setup.name, sensor, setup.zero))
    return tuple(found)


def _turned(keys: _TurnedKeys) -> TurnedSetup:
    return TurnedSetup(
        keys.name, _float(keys.as_read), _float(keys.turned), keys.evidence, tuple(keys.also)
    )


def _float(value: float | None) -> float:
    return math.nan if value is None else value
