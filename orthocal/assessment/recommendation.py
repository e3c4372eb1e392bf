"""Recommended model of the readings of a session, the same for `calibrate` and `compare`.

The complete model with priors is recommended unless the evidence strongly favours a smaller model
or another tolerance scale. The evidence is the marginal likelihood of the linearised model,

    p(y | M) = ∫ p(y | θ, σ) p(θ | M) dθ.

The parameters of the model have their prior standard deviations times the tolerance scale; all
other errors are 0. Joined sessions are of one machine, so they share θ. Gauge zeros have flat
priors. Parameters that are never negative have half-normal priors. σ is the stated noise of a
reading with its rounding. If none is stated, the evidence is integrated over σ with a broad prior.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from orthocal.arguments import require_kind
from orthocal.arrays import Array
from orthocal.errors import OrthocalError
from orthocal.estimation.selection import complete_model
from orthocal.estimation.tolerance_scale import trial_scales
from orthocal.hypotheses.likelihood import NOISE_SCALES, log_normal, log_of_sum, noise_weights
from orthocal.hypotheses.linear_model import LinearModel, linear_model
from orthocal.hypotheses.linearisation import ModelLinearisation
from orthocal.session.session import Session

CACHE_SIZE = 4
"""Number of cached recommendations."""

STRONG = 5.0
"""ln of the Bayes factor above which evidence is strong: 150 to 1 (Kass and Raftery, 1995)."""

NEARLY_EQUAL = 3.0
"""Difference of the log evidence below which models are nearly equally well supported."""

TRIAL_SCALES = trial_scales(0.1, 10.0)[::3]
"""Tolerance scales whose evidence is computed."""

TRIAL_SCALE_SPREAD = 1.0
"""Prior standard deviation of ln(tolerance scale)."""


@dataclass(frozen=True, slots=True, eq=False)
class Recommendation:
    """Recommended model and the evidence for it."""

    model: str
    tolerance_scale: float
    """Recommended tolerance scale; 1 unless the evidence for another one is strong."""
    evidence: Mapping[str, float]
    """Model to ln p(y | M) minus that of the complete model; NaN if it cannot be computed."""
    scale_evidence: float
    """Log evidence of this scale relative to the stated tolerances; 0 if the scale is 1."""

    def log_evidence_of(self, model: str) -> float:
        """Log evidence of a model relative to the complete model; NaN if it was not computed."""
        return self.evidence.get(model, math.nan)


def recommend_model(session: Session, models: Sequence[str] = ()) -> Recommendation:
    """Recommended model, cached because several calibrations of one session need it.

    A smaller model is recommended if its evidence is strong, and at most NEARLY_EQUAL below that of
    the best tolerance scale. Otherwise the complete model is recommended, with the best tolerance
    scale if the evidence for it is strong.

    Args:
        session: The session, or several that were joined.
        models: Models of the robot to compare with the complete model; by default all.

    Raises:
        TypeError: If an argument is of another kind.
    """
    require_kind(session, Session, expected="a Session, as load_session returns")
    return _recommend(session, tuple(models))


@lru_cache(maxsize=CACHE_SIZE)
def _recommend(session: Session, models: tuple[str, ...]) -> Recommendation:
    """Recommended model; see `recommend_model`."""
    parameters = session.robot.parameters
    complete = complete_model(parameters)
    names = [m for m in dict.fromkeys(models or parameters.models) if m != complete]
    reference, by_scale = compute_log_evidence(session, complete)
    evidence = {}
    for name in names:
        try:
            evidence[name] = compute_log_evidence(session, name)[0] - reference
        except OrthocalError:
            evidence[name] = math.nan
    best = int(np.argmax(by_scale + log_normal(TRIAL_SCALES, TRIAL_SCALE_SPREAD)))
    gain = float(by_scale[best] - reference)  # without the prior, which only selects the scale
    sufficient = max(STRONG, gain - NEARLY_EQUAL)
    supported = [name for name, value in evidence.items() if value >= sufficient]
    evidence = {complete: 0.0, **evidence}
    if supported:
        return Recommendation(max(supported, key=evidence.__getitem__), 1.0, evidence, 0.0)
    if gain < STRONG:
        return Recommendation(complete, 1.0, evidence, 0.0)
    return Recommendation(complete, float(TRIAL_SCALES[best]), evidence, gain)


def compute_log_evidence(
    session: Session, model: str, *, noise_effects: Sequence[str] | None = None
) -> tuple[float, Array]:
    """Log evidence at the stated tolerances, and at all TRIAL_SCALES, shape (n_scales,).

    Args:
        session: The session, or several that were joined.
        model: Name of the model.
        noise_effects: As for `LinearModel`, to compare sets of effects with the same noise.
    """
    if len(session.readings) < 2:  # one reading usually determines only a gauge zero
        return 0.0, np.zeros(TRIAL_SCALES.size)
    linear = linear_model(session, model, noise_effects=noise_effects)
    about, scales = linear.most_likely(session.values), np.append(1.0, TRIAL_SCALES)
    evidence = weigh_scales(linear, about, session.values, scales)
    return float(evidence[0]), evidence[1:]


def weigh_scales(
    linear: LinearModel, about: ModelLinearisation, values: Array, scales: Array
) -> Array:
    """Log evidence of readings at each tolerance scale, shape (n_scales,).

    Args:
        linear: The model.
        about: Its linearisation.
        values: Readings, shape (n_rows,), [m].
        scales: Tolerance scales, shape (n_scales,).
    """
    deviation = linear.entries(values[None])[0] - about.expected
    noises, log_weights = np.ones(1), np.zeros(1)
    if not linear.stated:
        noises, log_weights = NOISE_SCALES, noise_weights(stated=False)
    likelihood = about.likelihood
    logs = likelihood.log_densities(likelihood.products(deviation[None]), scales, noises)
    logs = logs.reshape(scales.size, noises.size)
    positive = np.array([p.positive for p in linear.problem.parameters])
    if positive.any():
        logs += [
            [
                about.log_positive_share(
                    deviation,
                    positive,
                    linear.reference / linear.problem.theta_scale,
                    tolerance_scale=float(scale),
                    noise_scale=float(noise),
                )
                for noise in noises
            ]
            for scale in scales
        ]
    return log_of_sum(logs + log_weights, axis=1)
