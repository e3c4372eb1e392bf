"""Anomalies of a session as data: what happened, where, how large, and how sure."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from orthocal.units import Unit

AnomalyKind = Literal[
    "wrong unit",
    "decimal point",
    "reversed sign",
    "misread dial",
    "outlier",
    "inconsistent posture",
    "inconsistent setup",
    "swapped rows",
    "row offset",
    "stuck dial",
    "displaced gauge",
    "displaced artefact",
    "wrong dimension",
    "readjusted dimension",
    "drift",
    "backlash",
    "thermal expansion",
    "periodic screw error",
    "other effect",
    "offsets not entered",
    "offsets reversed",
    "offsets entered twice",
    "offsets interchanged",
    "offset of one drive",
    "machine changed",
]
"""Kinds of anomaly; `offset of one drive` is one that differs from the stated offset and matches
no known way to enter it wrongly. `other effect` is one from another package."""

EFFECT_KINDS: Mapping[str, AnomalyKind] = {
    "backlash": "backlash",
    "thermal": "thermal expansion",
    "screw": "periodic screw error",
    "drift": "drift",
}
"""Effects that readings may show although the machine's model lacks them."""

WRONGLY_ENTERED: tuple[AnomalyKind, ...] = (
    "offsets not entered",
    "offsets reversed",
    "offsets entered twice",
    "offsets interchanged",
)
"""Kinds that say which offsets are in the controller instead of those stated."""

Scope = Literal[
    "reading", "posture", "postures", "cycle", "setup", "setups", "leg", "legs", "gauge", "session"
]
"""What an anomaly concerns as a unit; `posture` is one posture in all cycles of a setup,
`postures` is a posture (or two) in all setups that read it."""

ORDERED: tuple[AnomalyKind, ...] = ("displaced gauge", "row offset", "stuck dial")
"""Kinds that begin in one row and go on to later ones."""


@dataclass(frozen=True, slots=True)
class Explanation:
    """One thing that may have happened: all that its wording needs."""

    kind: AnomalyKind
    scope: Scope
    rows: tuple[int, ...] = ()
    """Rows of the session that are wrong, in the order of measuring. Of `swapped rows` the first
    half, in the same order as their counterparts in the second half. Of a row offset from the first
    row that is wrong on."""
    setups: tuple[str, ...] = ()
    """Setups that are concerned as a whole."""
    names: tuple[str, ...] = ()
    """Legs, gauges or postures that the scope refers to; a displaced artefact; the key of a wrong
    dimension, its stated size in mm and, of a readjusted one, the session from which on."""
    cycle: int | None = None
    """The cycle, where one alone is concerned."""
    factor: float | None = None
    """Factor that corrects the readings."""
    amount: float | None = None
    """Amount by which the rows are too large, [m] (misread dial, outlier, displaced gauge; for a
    drift of the last row against the first; of other effects the range of what they add to the
    rows); of `machine changed` the change, [SI]; of a wrong or readjusted dimension its true
    less its stated size, [m]."""
    std: float | None = None
    """Standard deviation of the amount, [SI]."""
    missing: bool | None = None
    """Of a row offset: True where the first of the rows was not read, False where the row before
    was written twice, so that the last reading was lost."""
    drives: tuple[str, ...] = ()
    """Drives whose offsets are concerned."""
    offsets: tuple[float, ...] = ()
    """Offsets that are in the controller instead of those stated, one per drive of the robot,
    [m, rad]."""
    effect: str = ""
    """Name of the effect that the machine or its gauges have, and its model lacks."""
    parameters: tuple[str, ...] = ()
    """Error parameters that changed, or those of an effect."""
    amounts: tuple[float, ...] = ()
    """Of an effect the value of each parameter, [SI]."""
    stds: tuple[float, ...] = ()
    """Standard deviations of the amounts, [SI]."""
    units: tuple[Unit, ...] = ()
    """Their units."""
    sessions: tuple[str, ...] = ()
    """Sessions that are concerned, or the first session after a change; empty for a single one."""
    apart: bool = False
    """Whether the machine changed for these sessions only, and not from the first of them on."""

    def agrees_with(self, other: Explanation) -> bool:
        """True if both concern the same rows up to one at an end, or drives of the same session."""
        if not self.rows or not other.rows:
            same = self.drives == other.drives and self.sessions == other.sessions
            return self == other or (bool(self.drives) and same)
        if set(self.rows) == set(other.rows):
            no_setups = not (self.setups or other.setups)
            return len(self.rows) == 1 or self.kind == other.kind or no_setups
        apart = set(self.rows) ^ set(other.rows)
        return self.kind == other.kind and self.kind in ORDERED and len(apart) <= 1


@dataclass(frozen=True, slots=True)
class Anomaly:
    """An explanation that the readings prefer to no anomaly."""

    explanation: Explanation
    log_evidence: float
    """Logarithm of the Bayes factor of all anomalies found against those without this one, prior
    probabilities of its kind and place included."""
    expected: float | None
    """Predicted value of the row, where a single row is concerned, [m]."""
    causes: tuple[Explanation, ...] = ()
    """Other explanations of the same rows that are nearly as likely; then only the rows are
    certain."""
    alternatives: tuple[Explanation, ...] = ()
    """Explanations elsewhere that are nearly as likely."""

    @property
    def ambiguous(self) -> bool:
        """True if an explanation elsewhere is nearly as likely."""
        return bool(self.alternatives)

    @property
    def between_sessions(self) -> bool:
        """True if it is, or may be, a change between sessions."""
        return any(e.sessions for e in (self.explanation, *self.alternatives))


@dataclass(frozen=True, slots=True)
class Anomalies:
    """Result of the search for anomalies in one session or several joined ones."""

    found: tuple[Anomaly, ...]
    log_evidence: float
    """Logarithm of the Bayes factor of the anomalies found against none."""
    explained: bool
    """Whether the readings are those of a machine near its tolerances once the anomalies are
    corrected; if not, something else is wrong as well."""
    rms_before: float
    """RMS residual of a machine within its tolerances, [m]."""
    rms_after: float
    """The same once the anomalies are corrected, [m]; infinite if no machine shows them."""
    tolerance_scale: float
    """Most likely factor between the machine's errors and their tolerances."""
    noise_scale: float
    """Most likely factor between the noise and its stated standard deviation."""

    @property
    def ambiguous(self) -> bool:
        """True if any anomaly is ambiguous."""
        return any(a.ambiguous for a in self.found)
