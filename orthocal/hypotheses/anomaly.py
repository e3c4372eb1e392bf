"""Anomalies of a session as data: kind, place, amount and evidence."""

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
    "backlash not entered",
    "backlash halved",
    "backlash entered twice",
    "settings not entered",
    "settings interchanged",
    "bed moved",
    "machine changed",
    "lost steps",
]
"""Kinds of anomaly. `offset of one drive`: an offset that differs from the stated one and matches
no usual mistake of entering it. `other effect`: an effect from another package."""

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
    "backlash not entered",
    "backlash halved",
    "backlash entered twice",
)
"""Kinds that state which numbers the controller has instead of the stated ones."""

Scope = Literal[
    "reading", "posture", "postures", "cycle", "setup", "setups", "leg", "legs", "gauge", "session"
]
"""Unit to which an anomaly belongs. `posture`: one posture in all cycles of a setup. `postures`:
one posture (or two) in all setups that read it."""

PERSISTENT: tuple[AnomalyKind, ...] = ("displaced gauge", "row offset", "stuck dial")
"""Kinds that affect all rows from one row on."""


@dataclass(frozen=True, slots=True)
class Explanation:
    """One possible event, with everything that its wording needs."""

    kind: AnomalyKind
    scope: Scope
    rows: tuple[int, ...] = ()
    """Wrong rows of the session, in the order of measuring. `swapped rows`: each row of the first
    half is swapped with the row at the same place of the second half. `row offset`: all rows from
    the first wrong one on."""
    setups: tuple[str, ...] = ()
    """Setups of which all readings are concerned."""
    names: tuple[str, ...] = ()
    """Legs, gauges or postures that the scope refers to; a displaced artefact; the key of a wrong
    dimension and its stated value in mm. `readjusted dimension`: also the first session with the
    other value. `settings not entered`, `settings interchanged`: settings of a firmware; empty if
    all of them are concerned."""
    cycle: int | None = None
    """The cycle, if only one is concerned."""
    factor: float | None = None
    """Factor that corrects the readings."""
    amount: float | None = None
    """Amount of the anomaly. Misread dial, outlier, displaced gauge: excess of the rows, [m].
    Drift: excess of the last row over the first, [m]. Other effects: range of their contributions
    to the rows, [m]. `machine changed`, `lost steps`: the change, [SI]. Wrong or readjusted
    dimension: true minus stated value, [m]."""
    std: float | None = None
    """Standard deviation of the amount, [SI]."""
    missing: bool | None = None
    """Row offset: True if the first of the rows was not read, False if the row before was written
    twice, so that the last reading was lost."""
    first: int | None = None
    """Lost steps: first row that was read after the loss."""
    drives: tuple[str, ...] = ()
    """Drives whose offsets or backlashes are concerned."""
    active: tuple[float, ...] = ()
    """Offsets or backlashes in the controller instead of the stated ones, one per drive,
    [m, rad]."""
    effect: str = ""
    """Name of an effect of the machine or its gauges that the model lacks."""
    parameters: tuple[str, ...] = ()
    """Error parameters that changed or that the controller corrects, or those of an effect."""
    amounts: tuple[float, ...] = ()
    """Value of each parameter of an effect, [SI]."""
    stds: tuple[float, ...] = ()
    """Standard deviations of the amounts, [SI]."""
    units: tuple[Unit, ...] = ()
    """Units of the parameters."""
    sessions: tuple[str, ...] = ()
    """Sessions concerned, or the first session after a change; empty for a single session."""
    apart: bool = False
    """Whether the machine changed for these sessions only, not from the first of them on."""

    def agrees_with(self, other: Explanation) -> bool:
        """True if both concern the same parameters and sessions, or the same rows.

        Rows of a kind in PERSISTENT may differ by one.
        """
        if not self.rows or not other.rows:
            same = self.parameters == other.parameters and self.sessions == other.sessions
            return self == other or (bool(self.parameters) and same)
        if set(self.rows) == set(other.rows):
            no_setups = not (self.setups or other.setups)
            return len(self.rows) == 1 or self.kind == other.kind or no_setups
        difference = set(self.rows) ^ set(other.rows)
        return self.kind == other.kind and self.kind in PERSISTENT and len(difference) <= 1


@dataclass(frozen=True, slots=True)
class Anomaly:
    """An explanation whose evidence exceeds that of no anomaly."""

    explanation: Explanation
    log_evidence: float
    """Logarithm of the Bayes factor of the set of anomalies with and without this one. It includes
    the prior probabilities of kind and place."""
    expected: float | None
    """Predicted value of the row, if a single row is concerned, [m]."""
    causes: tuple[Explanation, ...] = ()
    """Nearly as likely explanations of the same rows; then only the rows are certain."""
    alternatives: tuple[Explanation, ...] = ()
    """Nearly as likely explanations in other rows."""


@dataclass(frozen=True, slots=True)
class Anomalies:
    """Result of the search for anomalies in one session or several joined ones."""

    found: tuple[Anomaly, ...]
    explained: bool
    """Whether a machine near its tolerances explains the corrected readings. If not, there is a
    further cause."""
    rms_before: float
    """RMS residual of a machine within its tolerances, [m]."""
    rms_after: float
    """RMS residual of such a machine after correction of the anomalies, [m]; infinite if no
    machine explains the corrected readings."""
    tolerance_scale: float
    """Most likely factor between the machine's errors and their tolerances."""
    suspected: tuple[int, ...] = ()
    """Rows of the most likely further mistakes, if anomalies were found and do not explain the
    readings."""
    log_posterior: float = 0.0
    """Logarithm of marginal likelihood times prior of the found anomalies, which compares different
    statements about the same readings."""
