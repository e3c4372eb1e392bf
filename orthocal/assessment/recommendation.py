"""Recommended model: one function of the readings, for `calibrate` and `compare` alike.

The complete model with priors is recommended unless the readings speak strongly for a smaller one,
or for tolerances of another size. They are weighed by the marginal likelihood of the linearised
model,

    p(y | M) = ∫ p(y | θ, σ) p(θ | M) dθ,

with the parameters of the model at their prior standard deviations (times a scale) and all others
at 0, gauge zeros free. Parameters that are never negative have half-normal priors. σ is the stated
noise of a reading, with its rounding; if none is stated it is integrated over with a broad prior.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from orthocal.arrays import Array
from orthocal.errors import OrthocalError
from orthocal.estimation.selection import complete_model
from orthocal.hypotheses.likelihood import NOISE_SCALES, log_of_sum, noise_weights
from orthocal.hypotheses.linear_model import linear_model
from orthocal.measurement.joining import split_sessions
from orthocal.session.session import Session

KEPT = 4
"""Recommendations that are kept."""

STRONG = 5.0
"""ln of the Bayes factor from which evidence is strong: 150 to 1 (Kass and Raftery, 1995)."""

NEARLY = 3.0
"""Difference of ln evidence up to which models are nearly as well supported."""

SCALES = np.geomspace(0.1, 10.0, 41)
"""Scales of the tolerances that are weighed."""

SCALE_SPREAD = 1.0
"""Standard deviation of ln(scale) before the readings."""


@dataclass(frozen=True, slots=True, eq=False)
class ModelEvidence:
    """Evidence of the readings for one model."""

    model: str
    log_evidence: float
    """ln p(y | M) less that of the complete model; NaN if the model cannot be weighed."""


@dataclass(frozen=True, slots=True, eq=False)
class Recommendation:
    """The model that the readings recommend, and the evidence for it."""

    model: str
    tolerance_scale: float
    """Factor of the tolerances that the readings ask for; 1 unless the evidence is strong."""
    evidence: tuple[ModelEvidence, ...]
    """Of every model, relative to the complete one."""
    scale_evidence: float
    """ln evidence of tolerances at that factor, relative to the stated ones."""

    def of(self, model: str) -> float:
        """Ln evidence of a model relative to the complete one; NaN if it was not weighed."""
        return next((e.log_evidence for e in self.evidence if e.model == model), math.nan)


def recommend_model(session: Session, models: Sequence[str] = ()) -> Recommendation:
    """The model that the readings recommend.

    The last recommendations are kept: several models are calibrated from one session, or compared.

    Args:
        session: The session, or several that were joined: their evidence adds up.
        models: Models of the robot to weigh against the complete one; by default all.
    """
    return _recommend(session, tuple(models))


@lru_cache(maxsize=KEPT)
def _recommend(session: Session, models: tuple[str, ...]) -> Recommendation:
    parameters = session.robot.parameters
    complete = complete_model(parameters)
    names = [m for m in dict.fromkeys(models or parameters.models) if m != complete]
    reference, by_scale = weigh_model(session, complete)
    evidence = [ModelEvidence(complete, 0.0)]
    for name in names:
        try:
            evidence.append(ModelEvidence(name, weigh_model(session, name)[0] - reference))
        except OrthocalError:
            evidence.append(ModelEvidence(name, math.nan))
    prior = -0.5 * (np.log(SCALES) / SCALE_SPREAD) ** 2
    best = int(np.argmax(by_scale + prior))
    gain = float(by_scale[best] - reference)
    smaller = max(
        (e for e in evidence[1:] if math.isfinite(e.log_evidence)),
        key=lambda e: e.log_evidence,
        default=None,
    )
    strong_scale = gain >= STRONG
    # a smaller model is simpler than other tolerances that are nearly as well supported
    least = max(STRONG, gain - NEARLY)
    if smaller is not None and smaller.log_evidence >= least:
        return Recommendation(smaller.model, 1.0, tuple(evidence), 0.0)
    scale = float(SCALES[best]) if strong_scale else 1.0
    return Recommendation(complete, scale, tuple(evidence), gain if strong_scale else 0.0)


def weigh_model(session: Session, model: str, *, free: tuple[str, ...] = ()) -> tuple[float, Array]:
    """Ln p(y | M) at the stated tolerances, and at each of SCALES, shape (n_scales,).

    Args:
        session: The session, or several that were joined.
        model: Name of the model.
        free: Names of further errors that are free.
    """
    total, by_scale = 0.0, np.zeros(SCALES.size)
    for part in split_sessions(session):
        if len(part.readings) < 2:
            continue
        readings = linear_model(part, model, free=free)
        about = readings.most_likely(part.values)
        deviation = readings.entries(part.values[None])[0] - about.expected
        stated = readings.stated
        noises, weights = (
            (np.ones(1), np.zeros(1)) if stated else (NOISE_SCALES, noise_weights(stated=False))
        )
        scales = np.append(1.0, SCALES)
        likelihood = about.likelihood
        logs = likelihood.log_densities(likelihood.products(deviation[None]), scales, noises)
        logs = logs.reshape(scales.size, noises.size)
        positive = np.array([p.positive for p in readings.problem.parameters])
        if positive.any():
            logs += [
                [
                    about.log_positive_share(
                        deviation, positive, tolerance_scale=float(e), noise_scale=float(s)
                    )
                    for s in noises
                ]
                for e in scales
            ]
        evidence = log_of_sum(logs + weights, axis=1)
        total += float(evidence[0])
        by_scale += evidence[1:]
    return total, by_scale
