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

from orthocal.assess.accuracy import assess_excess, find_excess
from orthocal.assess.repetition import Repetition
from orthocal.assess.scores import ModelResult, Undetermined
from orthocal.measurement.session import Session
from orthocal.statistics.noise import KnownNoise
from orthocal.units import MM, UM

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
    reasons: tuple[str, ...]
    judgements: tuple[Judgement, ...]
    """Of every model, those that the readings leave open first."""

    def standing(self, model: str) -> Standing:
        """How a model stands."""
        return next(j.standing for j in self.judgements if j.model == model)

    @property
    def exit_code(self) -> int:
        """0: supported, and noise remains. 3: supported, but model error remains. 4: none is."""
        if self.supported is None:
            return 4
        return 3 if self.model_error else 0


def give_verdict(
    results: Sequence[ModelResult],
    undetermined: Sequence[Undetermined],
    *,
    noise: KnownNoise,
    repetition: tuple[Repetition, Session] | None = None,
) -> Verdict:
    """Which model to believe, and why.

    Args:
        results: Models that the readings determine, the smallest first.
        undetermined: Models that they do not.
        noise: What residuals are held against.
        repetition: Residuals of the supported model held against those of another session.
    """
    best, judgements = judge_models(results, undetermined)
    reasons = [f"{j.model}: {j.words}" for j in judgements]
    if best is None:
        headline = "These readings support none of the models."
        return Verdict(None, None, (headline, *reasons), judgements)
    model_error, excess, words = _explain_remainder(best, noise)
    reasons += words
    if repetition is not None:
        words, model_error = _explain_repetition(*repetition, model_error)
        reasons += words
    reasons += _explain_tool(best, excess)
    headline = _headline(best, results, undetermined)
    return Verdict(best.model, model_error, (headline, *reasons), judgements)


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
                f"It leaves {_count(result.spare)} of {_count(total)} independent readings to "
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


def _headline(
    best: ModelResult, results: Sequence[ModelResult], undetermined: Sequence[Undetermined]
) -> str:
    count = _count(best.rank + best.spare).capitalize()
    others = [*(r.n_free for r in results), *(u.n_free for u in undetermined)]
    only = " only" if best.n_free == min(others) < max(others) else ""
    return f"{count} independent readings support {best.model}{only}."


def _explain_remainder(
    best: ModelResult, noise: KnownNoise
) -> tuple[bool | None, float, list[str]]:
    """Whether what the supported model leaves is noise, and by how much it is beyond tolerances."""
    calibration = best.calibration
    dof, chi_square = best.exact.dof, best.exact.chi_square
    found = calibration.noise.residual_sigma
    exceeded = noise.is_exceeded(chi_square, dof)
    if exceeded is None:
        words = [
            "Whether what remains is noise cannot be told: nothing says what the noise is. Repeat "
            "readings in cycles, or give gauge.sigma_mm."
        ]
        return None, 1.0, words
    factor = calibration.row_factor
    row = "a difference" if calibration.rows_are_differences else "a reading"
    where = {"cycles": "repeated cycles scatter", "gauge": "the gauge's own σ"}[noise.source]
    sizes = f"σ {found * factor / MM:.3g} mm of {row} against {noise.sigma * factor / MM:.2g} mm"
    if not exceeded:
        return False, 1.0, [f"What {best.model} leaves is noise: {sizes} ({where})."]
    words = [
        f"What {best.model} leaves is error of the model rather than noise: {sizes} ({where}), "
        f"{_times(found / noise.sigma)} as much."
    ]
    tolerated, scale = calibration.unmodelled.residual_rms, find_excess(calibration)
    if tolerated > 0.0:
        rms = calibration.rms_after
        words.append(
            f"Errors that {best.model} leaves out, at their tolerances, would leave "
            f"{tolerated / MM:.3f} mm r.m.s.; found are {rms / MM:.3f} mm"
            + (
                f": this machine is worse than its tolerances, by about {scale:.1f} times."
                if scale > 1.0
                else ": they explain it."
            )
        )
    return True, scale, words


def _explain_repetition(
    repetition: Repetition, repeat: Session, model_error: bool | None
) -> tuple[list[str], bool | None]:
    sizes = f"correlation {repetition.correlation:.3f} over {repetition.matched} rows"
    if repetition.repeats is None:
        return ["Whether what remains repeats cannot be told: too few rows are shared."], (
            model_error
        )
    if repetition.repeats:
        return [
            f"What remains repeats in '{repeat.title}' ({sizes}; by chance {repetition.chance:.2g})"
            ": it is error of the model, which no repetition removes."
        ], True
    return [f"What remains does not repeat in '{repeat.title}' ({sizes})."], model_error


def _explain_tool(best: ModelResult, excess: float) -> list[str]:
    """What the supported model is good for at the tool, with errors beyond their tolerances."""
    if best.tool is None or best.tool.after is None:
        return []
    after, cost = best.tool.after.sizes.headline, best.linearisation_cost
    words = [
        f"At the tool {best.model} is good for {after.rms / UM:.0f} µm r.m.s. over "
        f"{best.tool.workspace.words}, shift and rotation taken out, if the tolerances hold."
    ]
    if excess > 1.0:
        size = assess_excess(best.calibration, best.tool, excess).sizes.headline
        words[0] = (
            f"At the tool {best.model} is good for about {size.rms / UM:.0f} µm r.m.s. over "
            f"{best.tool.workspace.words}, shift and rotation taken out, with errors "
            f"{excess:.1f} times their tolerances."
        )
    if cost is not None:
        words.append(f"Linearising it costs {cost.rms / UM:.1f} µm r.m.s. there.")
    return words


def _times(ratio: float) -> str:
    return f"{ratio:.1f} times" if ratio < 3.0 else f"{ratio:.0f} times"


def _count(value: int) -> str:
    words = ("no", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine")
    return words[value] if 0 <= value < len(words) else str(value)
