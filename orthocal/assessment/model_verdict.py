"""Which of several models to believe, and why.

A model is judged by what the readings can check of it, not by how small its residuals are. With as
many parameters as independent readings they are zero whatever the machine is like. So a model must
leave readings to spare, tell more than a smaller one, describe the readings better by more than its
extra parameters buy (AICc; Hurvich and Tsai, 1989), and predict setups that it has not seen better.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from orthocal.assessment.repetition import Repetition
from orthocal.assessment.scores import ModelResult, Undetermined
from orthocal.assessment.tool_error import find_excess
from orthocal.assessment.wording import count_of
from orthocal.statistics.noise import KnownNoise
from orthocal.units import MM

Standing = Literal[
    "supported", "no check", "tells no more", "no better", "does not carry over", "not determined"
]

NOT_ALONE = (
    " The readings alone do not determine it: what they leave open is held by the tolerances."
)

TELLING = 0.5
"""Effective parameters by which a larger model must exceed a smaller one to say anything new."""

WORTHWHILE = 2.0
"""Least drop of AICc for which a larger model is preferred (Burnham and Anderson, 2002, 2.6)."""


@dataclass(frozen=True, slots=True, eq=False)
class Judgement:
    """How a model stands, and why."""

    model: str
    standing: Standing
    reason: str

    @property
    def words(self) -> str:
        """Standing and reason in a sentence or two."""
        if self.standing in ("tells no more", "no better"):
            return self.reason
        word = "supported" if self.standing == "supported" else "not supported"
        if self.standing == "not determined":
            word = self.standing
        return f"{word}. {self.reason}"


@dataclass(frozen=True, slots=True, eq=False)
class Verdict:
    """Which model to believe, and why."""

    supported: str | None
    """The largest model that the readings support; None if they support none."""
    model_error: bool | None
    """Whether what it leaves is error of the model, not noise; None if nothing tells."""
    excess: float
    """How many times their tolerances errors must be for that; 1 where they explain it."""
    judgements: tuple[Judgement, ...]
    """Of every model, those that the readings leave open first."""

    def standing(self, model: str) -> Standing:
        """How a model stands."""
        return next(j.standing for j in self.judgements if j.model == model)


def give_verdict(
    results: Sequence[ModelResult],
    undetermined: Sequence[Undetermined],
    *,
    noise: KnownNoise,
    repetition: Repetition | None = None,
) -> Verdict:
    """Which model to believe, and why.

    Args:
        results: Models that the readings determine, the smallest first.
        undetermined: Models that they do not.
        noise: What residuals are held against.
        repetition: Residuals of the supported model held against those of another session.
    """
    best, judgements = judge_models(results, undetermined)
    if best is None:
        return Verdict(None, None, 1.0, judgements)
    exact = best.exact
    model_error = noise.is_exceeded(exact.chi_square, exact.dof)
    excess = find_excess(best.calibration) if model_error else 1.0
    if repetition is not None and repetition.repeats is True:
        model_error = True
    return Verdict(best.model, model_error, excess, judgements)


def judge_models(
    results: Sequence[ModelResult], undetermined: Sequence[Undetermined]
) -> tuple[ModelResult | None, tuple[Judgement, ...]]:
    """The largest model that earns its parameters, and why the others do not."""
    best: ModelResult | None = None
    found = [Judgement(u.model, "not determined", f"{u.reason}.") for u in undetermined]

    def judge(result: ModelResult, standing: Standing, reason: str) -> None:
        found.append(Judgement(result.model, standing, reason))

    for result in results:
        total = result.rank + result.spare
        if result.spare < 1:
            judge(
                result,
                "no check",
                f"Its {result.n_free} parameters can take up all {total} independent readings: "
                + ("what remains is decided by the tolerances, and " if result.prior else "")
                + "no reading is left to check it. Small residuals say nothing of it.",
            )
            continue
        if best is None:
            best = result
            held = "" if result.by_choice else NOT_ALONE
            judge(
                result,
                "supported",
                f"It leaves {count_of(result.spare)} of {count_of(total)} independent readings to "
                f"check it.{held}",
            )
            continue
        if result.effective < best.effective + TELLING:
            judge(
                result,
                "tells no more",
                f"no more than {best.model}. Beside the tolerances the readings tell "
                f"{result.effective:.1f} of its {result.n_free} parameters, as many as of "
                f"{best.model}: what it adds stays where the tolerances put it.",
            )
            continue
        gain = best.exact.aicc - result.exact.aicc
        old, new = best.exact.unseen_rms, result.exact.unseen_rms
        predicts = not new >= old  # unknown counts for the model
        words = f"unseen setups are predicted to {new / MM:.4f} mm instead of {old / MM:.4f} mm"
        if gain > WORTHWHILE and predicts:
            judge(
                result,
                "supported",
                f"It describes the readings better than {best.model} by more than its parameters "
                f"buy (AICc lower by {gain:.0f}), and {words}.",
            )
            best = result
        elif gain > WORTHWHILE:
            judge(
                result,
                "does not carry over",
                f"It describes these readings better than {best.model}, but {words}: it learns "
                "what does not carry over.",
            )
        else:
            judge(
                result,
                "no better",
                f"no better than {best.model}. AICc is {'higher' if gain < 0 else 'lower'} by "
                f"{abs(gain):.1f}, and {words}.",
            )
    return best, tuple(found)
