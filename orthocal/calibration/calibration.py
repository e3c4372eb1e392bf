"""The result of a calibration, in memory and as calibration.json.

It holds all that a report, a scene or an export needs: none of them asks for the session again.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from orthocal.calibration.recorded_robot import (
    load_recorded_robot,
    require_offsets,
    require_parameters,
    require_rows,
)
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
from orthocal.diagnosis.rows import ResidualRow, root_mean_square
from orthocal.diagnosis.turned import TurnedSetup
from orthocal.diagnosis.unmodelled import Unmodelled
from orthocal.files import write_file
from orthocal.kinematics.assembly import Assembly, as_rows, find_beyond_travel
from orthocal.robot.model import Robot
from orthocal.sensors.registry import write_sensor
from orthocal.statistics.chance import BY_CHANCE, chance_of_excess, confidence_factor
from orthocal.statistics.identifiability import Combination, Identifiability

Array = NDArray[np.float64]

Found = TypeVar("Found")

SCHEMA = "orthocal/calibration/3"


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """Identified error parameters of a robot, with their uncertainty and provenance."""

    robot_record: RobotRecord
    session: SessionRecord
    model: str
    prior: bool
    """Whether tolerances acted as a prior."""
    solver: SolverRecord
    parameters: tuple[ParameterEstimate, ...]
    """Free parameters, then those held at a known value."""
    sensors: tuple[ParameterEstimate, ...]
    """What was not known of the sensors, estimated with them."""
    covariance: Array
    """Of the free parameters, shape (n_free, n_free), [SI]."""
    unmodelled: Unmodelled
    """What errors that were not free do to the estimate."""
    identifiability: Identifiability
    """What the readings tell, and what they cannot tell apart."""
    base: bool
    """Whether free parameters are base parameters: each the value of a whole combination."""
    noise: NoiseRecord
    sigma: float
    """Standard deviation of one row of the readings, [m]: of a difference where all are."""
    dof: float
    """Degrees of freedom of sigma."""
    rows_are_differences: bool
    residuals: tuple[ResidualRow, ...]
    turned: TurnedSetup | None
    """The setup that seems to have been read with the wrong sign."""
    critical: float
    """Studentised residuals beyond this are suspicious; infinite if nothing tells the noise."""
    postures: tuple[PostureRecord, ...]
    setups: tuple[SetupRecord, ...]
    gauges: tuple[GaugeRecord, ...]
    version: str
    """Of orthocal."""
    path: Path | None = None
    """Where it was loaded from."""
    _kept: dict[str, Any] = field(init=False, default_factory=dict)
    """What follows from the rest, once it was asked for."""

    def __getitem__(self, name: str) -> ParameterEstimate:
        for p in self.parameters:
            if p.name == name:
                return p
        raise KeyError(name)

    @property
    def free(self) -> tuple[ParameterEstimate, ...]:
        """Free parameters, in the order of the covariance."""
        return tuple(p for p in self.parameters if p.free)

    @property
    def errors(self) -> dict[str, float]:
        """Parameter name to exact estimate, [SI]."""
        return {p.name: p.value for p in self.parameters}

    @property
    def standard_deviations(self) -> Array:
        """Of the free parameters, shape (n_free,), [SI]."""
        return np.array([p.std for p in self.free])

    @property
    def correlation(self) -> Array:
        """Correlation of the free parameters, shape (n_free, n_free); NaN at a bound."""
        std = self.standard_deviations
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(self.covariance / np.outer(std, std))

    def correlated(self, *, above: float = 0.5) -> tuple[tuple[str, str, float], ...]:
        """Pairs of free parameters with a correlation above a size, strongest first."""
        names = [p.name for p in self.free]
        matrix = np.nan_to_num(self.correlation)
        pairs = [
            (names[i], names[j], float(matrix[i, j]))
            for i, j in zip(*np.nonzero(np.triu(np.abs(matrix) > above, 1)), strict=True)
        ]
        return tuple(sorted(pairs, key=lambda p: -abs(p[2])))

    @property
    def spare_readings(self) -> int:
        """Independent readings that the parameters leave to check the model."""
        found = self.identifiability
        return found.n_readings - (len(self.free) if self.base else found.structural_rank)

    @property
    def chance_within_tolerances(self) -> float | None:
        """Probability that a machine within its tolerances shows such readings, or odder ones.

        Beside a prior what is left of the readings and what the parameters took of their tolerances
        add up to χ² of the readings as the prior foretells them. None where the noise is not known
        but from the residuals.
        """
        known = self.noise.source in ("cycles", "gauge") and self.sigma > 0.0
        if not known or not self.prior or any(p.at_bound for p in self.free):
            return None
        left = sum((r.residual / self.sigma) ** 2 for r in self.residuals)
        taken = sum(((p.value - p.mean) / p.tolerance) ** 2 for p in self.free if p.prior)
        zeros = len({r.setup for r in self.residuals if r.minus is None})
        flat = sum(not p.prior for p in self.free)
        dof = len(self.residuals) - zeros - flat
        return chance_of_excess(left + taken, dof) if dof > 0 else None

    @property
    def suspicious(self) -> tuple[ResidualRow, ...]:
        """Rows that all the others contradict, the worst first."""
        rows = [r for r in self.residuals if abs(r.studentised) > self.critical]
        return tuple(sorted(rows, key=lambda r: -abs(r.studentised)))

    def where(self, row: ResidualRow) -> str:
        """File and line of a row, for messages."""
        file = row.file or self.session.readings_path
        if file is None or row.line is None:
            return f"reading {row.label}"
        return f"{file}:{row.line}"

    @property
    def rms_before(self) -> float:
        """Root mean square of the deviations, [m]."""
        return root_mean_square(r.deviation for r in self.residuals)

    @property
    def rms_after(self) -> float:
        """Root mean square of the residuals, [m]."""
        return root_mean_square(r.residual for r in self.residuals)

    @property
    def largest_before(self) -> float:
        """Largest absolute deviation, [m]."""
        return max(abs(r.deviation) for r in self.residuals)

    @property
    def largest_after(self) -> float:
        """Largest absolute residual, [m]."""
        return max(abs(r.residual) for r in self.residuals)

    @property
    def has_model_error(self) -> bool:
        """Whether more remains than the noise of repeated cycles, or of the gauge, explains.

        False where nothing tells that noise.
        """
        noise, gauge = self.noise, self.session.gauge_sigma
        if noise.source != "residuals":
            return False
        if noise.cycles_dof > 0:
            return True  # else sigma would be theirs
        return gauge is not None and noise.chance_in_residuals(gauge) < BY_CHANCE

    @property
    def row_factor(self) -> float:
        """Standard deviation of a row over that of one reading: √2 if all rows are differences."""
        return math.sqrt(2.0) if self.rows_are_differences else 1.0

    @property
    def confidence_factor(self) -> float:
        """Standard deviations on either side of an estimate in its 95 % interval."""
        return confidence_factor(self.dof)

    @property
    def total_std(self) -> Array:
        """Standard deviations of the free parameters from all that is not known, (n_free,), [SI].

        What the scatter of the readings and the priors leave open, and what errors of the machine
        that were not free, at their tolerances, have moved.
        """
        return np.asarray(np.hypot(self.standard_deviations, self._bias_std))

    @property
    def intervals(self) -> tuple[tuple[float, float], ...]:
        """95 % intervals of the free parameters, with all that is not known, [unit].

        Student's factor counts for the share that the readings told: what only the prior tells, or
        the tolerances of errors that were not free, has no part in the degrees of freedom of their
        scatter. Infinite where nothing tells the noise.
        """
        student, normal = self.confidence_factor, confidence_factor(math.inf)
        found = []
        for p, bias in zip(self.free, self._bias_std, strict=True):
            share = 1.0 if math.isnan(p.data_share) else max(p.data_share, 0.0)
            square = (share * student**2 if share > 0.0 else 0.0) + (1.0 - share) * normal**2
            half = math.sqrt(square * p.std**2 + (normal * float(bias)) ** 2)
            found.append((p.value - half, p.value + half))
        return tuple(found)

    @property
    def _bias_std(self) -> Array:
        bound = np.array([p.at_bound is not None for p in self.free])
        bias = np.sqrt(np.diag(self.unmodelled.bias_covariance))
        return np.where(bound, 0.0, bias)

    @property
    def robot(self) -> Robot:
        """The nominal robot.

        Raises:
            RobotError: If it cannot be found or loaded.
            CalibrationFileError: If its files are not those that were calibrated.
        """
        return self.remember("robot", self._load_robot)

    def remember(self, name: str, find: Callable[[], Found]) -> Found:
        """What follows from this calibration, found once and kept with it.

        Args:
            name: Of what is found.
            find: How.
        """
        if name not in self._kept:
            self._kept[name] = find()
        found: Found = self._kept[name]
        return found

    @property
    def active_offsets(self) -> Array:
        """Offsets in the controller while measuring, 0 where not stated, (n_drives,), [m, rad]."""
        stated = self.session.controller_offsets
        return np.zeros(len(self.robot.drives)) if stated is None else np.array(stated)

    @property
    def only_offsets(self) -> bool:
        """Whether the machine as identified has no errors but offsets."""
        offsets = {f"{d.name}.offset" for d in self.robot.drives}
        return all(p.name in offsets for p in self.parameters if p.free or p.value != 0.0)

    def forward(self, joints: ArrayLike, *, names: Sequence[str] | None = None) -> Array:
        """Tool centre point of the calibrated machine.

        Args:
            joints: Drive coordinates as the encoders give them, without any offset of the
                controller, shape (K, n_drives) or (n_drives,), [m, rad].
            names: What to call the rows in messages.

        Returns:
            Shape (K, 3) or (3,), [m].

        Raises:
            ClosureError: If the machine cannot be at such coordinates.
        """
        robot = self.robot
        rows, single = as_rows(joints, len(robot.drives), "drive coordinates")
        labels = names or [f"posture {i + 1}" for i in range(len(rows))]
        for error in find_beyond_travel(robot, rows, labels).values():
            raise error
        points = Assembly(robot, fixed=self.errors).forward(rows, names=labels)
        return points[0] if single else points

    def inverse(self, points: ArrayLike, *, names: Sequence[str] | None = None) -> Array:
        """Drive coordinates that bring the calibrated machine's tool to given points.

        Args:
            points: Shape (K, n_drives) or (n_drives,), [m].
            names: What to call the rows in messages.

        Returns:
            Drive coordinates as the encoders give them, shape (K, n_drives) or (n_drives,).

        Raises:
            ClosureError: If a point cannot be reached.
        """
        return Assembly(self.robot, fixed=self.errors).inverse(points, names=names)

    def to_document(self) -> dict[str, Any]:
        """As plain data: the content of calibration.json."""
        return {
            "schema": SCHEMA,
            "orthocal": self.version,
            "robot": _plain(self.robot_record),
            "session": _session_document(self.session),
            "model": self.model,
            "prior": self.prior,
            "solver": _plain(self.solver),
            "parameters": [_plain(p) for p in self.parameters],
            "sensors": [_plain(p) for p in self.sensors],
            "covariance": [[_number(v) for v in row] for row in self.covariance.tolist()],
            "sigma": _number(self.sigma),
            "dof": _number(self.dof),
            "unmodelled": {
                "names": list(self.unmodelled.names),
                "tolerances": self.unmodelled.tolerances.tolist(),
                "leakage": self.unmodelled.leakage.tolist(),
                "residual_rms": self.unmodelled.residual_rms,
            },
            "identifiability": _identifiability_document(self.identifiability),
            "base": self.base,
            "noise": _plain(self.noise),
            "rows_are_differences": self.rows_are_differences,
            "rms_before": self.rms_before,
            "rms_after": self.rms_after,
            "largest_before": self.largest_before,
            "largest_after": self.largest_after,
            "critical": _number(self.critical),
            "residuals": [{**_plain(r), "residual": r.residual} for r in self.residuals],
            "turned": None if self.turned is None else _plain(self.turned),
            "postures": [_plain(p) for p in self.postures],
            "setups": [
                {"name": s.name, "reads": write_sensor(s.sensor), "zero": s.zero}
                for s in self.setups
            ],
            "gauges": [_plain(g) for g in self.gauges],
        }

    def to_json(self) -> str:
        """As the text of calibration.json."""
        return json.dumps(self.to_document(), indent=1, allow_nan=False) + "\n"

    def save(self, path: str | Path) -> Path:
        """Write calibration.json.

        Raises:
            OrthocalError: If it cannot be written.
        """
        write_file(Path(path), self.to_json())
        return Path(path)

    def _repr_html_(self) -> str:
        """In a notebook: the short answer."""
        import orthocal  # what is shown follows in later stages

        return orthocal.summarize(self, html=True)

    def _load_robot(self) -> Robot:
        robot = load_recorded_robot(self.robot_record, file=self.path)
        prefix = "" if self.path is None else f"{self.path}: "
        require_parameters(robot, self.parameters, self.unmodelled.names, prefix=prefix)
        require_rows(robot, self.setups, self.postures, self.residuals, prefix=prefix)
        require_offsets(robot, self.session.controller_offsets, prefix=prefix)
        return robot


def _session_document(record: SessionRecord) -> dict[str, Any]:
    parts = [{k: v for k, v in _plain(p).items() if k != "parts"} for p in record.parts]
    return {**_plain(record), "parts": parts}


def _identifiability_document(found: Identifiability) -> dict[str, Any]:
    def combination(c: Combination) -> list[list[Any]]:
        return [[name, coefficient] for name, coefficient in c.terms]

    return {
        "singular_values": found.singular_values.tolist(),
        "threshold": found.threshold,
        "rank": found.rank,
        "structural_rank": found.structural_rank,
        "condition": _number(found.condition),
        "observability": found.observability,
        "n_postures": found.n_postures,
        "n_readings": found.n_readings,
        "unseen": list(found.unseen),
        "told": list(found.told),
        "alike": [combination(c) for c in found.alike],
        "base": [combination(c) for c in found.base],
    }


def _number(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _plain(record: Any) -> dict[str, Any]:  # noqa: ANN401 - any of the records above
    result = {}
    for name in record.__slots__:
        value = getattr(record, name)
        if isinstance(value, float):
            value = _number(value)
        elif isinstance(value, tuple):
            value = list(value)
        result[name] = value
    return result
