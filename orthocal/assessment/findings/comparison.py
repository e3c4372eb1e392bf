"""All findings of a comparison of models, and which of them to believe."""

from __future__ import annotations

from orthocal.assessment.comparison import Comparison
from orthocal.assessment.findings.decision import Answer, Decision
from orthocal.assessment.findings.finding import Finding
from orthocal.assessment.scores import ModelResult
from orthocal.assessment.tool_error import assess_excess
from orthocal.assessment.wording import count_of, times
from orthocal.units import MM, UM


def decide_comparison(comparison: Comparison) -> Decision:
    """Which model the readings support, whether what it leaves is noise, and all that was found."""
    findings = find_comparison_findings(comparison)
    verdict = comparison.verdict
    answer: Answer = "supported"
    if verdict.supported is None:
        answer = "none supported"
    elif verdict.model_error:
        answer = "supported with model error"
    return Decision(answer, findings[0].text, findings[0].action, findings)


def find_comparison_findings(comparison: Comparison) -> tuple[Finding, ...]:
    """What is supported, why not the others, what is left, whether that repeats, at the tool."""
    verdict = comparison.verdict
    judged = tuple(
        Finding(
            "supported" if j.standing == "supported" else "not supported",
            "informs",
            f"{j.model}: {j.words}",
        )
        for j in verdict.judgements
    )
    if verdict.supported is None:
        text = "These readings support none of the models."
        action = "Read more setups or postures."
        return (Finding("not supported", "stops", text, action), *judged)
    best = comparison[verdict.supported]
    return (
        _lead(comparison, best),
        *judged,
        *_remainder(comparison, best),
        *_repetition(comparison),
        *_tool(comparison, best),
    )


def _lead(comparison: Comparison, best: ModelResult) -> Finding:
    total = best.rank + best.spare
    others = [
        *(r.n_free for r in comparison.results),
        *(u.n_free for u in comparison.undetermined),
    ]
    only = " only" if best.n_free == min(others) < max(others) else ""
    text = f"{count_of(total).capitalize()} independent readings support {best.model}{only}."
    return Finding("supported", "informs", text, numbers={"independent_readings": float(total)})


def _remainder(comparison: Comparison, best: ModelResult) -> list[Finding]:
    """Whether what the supported model leaves is noise, and by how much it is beyond tolerances."""
    calibration, noise = best.calibration, comparison.noise
    exceeded = noise.is_exceeded(best.exact.chi_square, best.exact.dof)
    if exceeded is None:
        text = "Whether what remains is noise cannot be told: nothing says what the noise is."
        action = "Repeat readings in cycles, or give gauge.sigma_mm."
        return [Finding("noise unknown", "warns", text, action)]
    found, factor = calibration.noise.residual_sigma, calibration.row_factor
    row = "a difference" if calibration.rows_are_differences else "a reading"
    where = {"cycles": "repeated cycles scatter", "gauge": "the gauge's own σ"}[noise.source]
    sizes = f"σ {found * factor / MM:.3g} mm of {row} against {noise.sigma * factor / MM:.2g} mm"
    numbers = {"sigma_mm": found * factor / MM, "noise_mm": noise.sigma * factor / MM}
    if not exceeded:
        text = f"What {best.model} leaves is noise: {sizes} ({where})."
        return [Finding("fits", "informs", text, numbers=numbers)]
    ratio = found / noise.sigma
    text = (
        f"What {best.model} leaves is error of the model rather than noise: {sizes} ({where}), "
        f"{times(ratio)} as much."
    )
    findings = [Finding("model error", "informs", text, numbers={**numbers, "times": ratio})]
    tolerated, excess = calibration.unmodelled.residual_rms, comparison.verdict.excess
    if tolerated > 0.0:
        rms = calibration.rms_after
        worse = (
            f": this machine is worse than its tolerances, by about {excess:.1f} times."
            if excess > 1.0
            else ": they explain it."
        )
        findings.append(
            Finding(
                "tolerances exceeded" if excess > 1.0 else "within tolerances",
                "informs",
                f"Errors that {best.model} leaves out, at their tolerances, would leave "
                f"{tolerated / MM:.3f} mm r.m.s.; found are {rms / MM:.3f} mm{worse}",
                numbers={
                    "times_tolerances": excess,
                    "left_rms_mm": rms / MM,
                    "tolerated_rms_mm": tolerated / MM,
                },
            )
        )
    return findings


def _repetition(comparison: Comparison) -> list[Finding]:
    """Whether what the supported model leaves is left in another session, too."""
    repetition, title = comparison.repetition, comparison.repeat_title
    if repetition is None:
        return []
    sizes = f"correlation {repetition.correlation:.3f} over {repetition.matched} rows"
    numbers = {"correlation": repetition.correlation, "rows": float(repetition.matched)}
    if repetition.repeats is None:
        text = f"Whether what remains repeats cannot be told: {repetition.untold}."
        return [Finding("repetition unknown", "informs", text, numbers=numbers)]
    if repetition.repeats:
        text = (
            f"What remains repeats in '{title}' ({sizes}; by chance {repetition.chance:.2g}): it "
            "is error of the model, which no repetition removes."
        )
        return [Finding("repeats", "informs", text, numbers=numbers)]
    text = f"What remains does not repeat in '{title}' ({sizes})."
    return [Finding("does not repeat", "informs", text, numbers=numbers)]


def _tool(comparison: Comparison, best: ModelResult) -> list[Finding]:
    """What the supported model is good for at the tool, with errors beyond their tolerances."""
    if best.tool is None or best.tool.after is None:
        return []
    excess, cost = comparison.verdict.excess, best.linearisation_cost
    size, region = best.tool.after.sizes.headline, best.tool.workspace.words
    text = (
        f"At the tool {best.model} is good for {size.rms / UM:.0f} µm r.m.s. over {region}, shift "
        "and rotation taken out, if the tolerances hold."
    )
    if excess > 1.0:
        size = assess_excess(best.calibration, best.tool, excess).sizes.headline
        text = (
            f"At the tool {best.model} is good for about {size.rms / UM:.0f} µm r.m.s. over "
            f"{region}, shift and rotation taken out, with errors {excess:.1f} times their "
            "tolerances."
        )
    findings = [Finding("at the tool", "informs", text, numbers={"expected_um": size.rms / UM})]
    if cost is not None:
        text = f"Linearising it costs {cost.rms / UM:.1f} µm r.m.s. there."
        numbers = {"cost_um": cost.rms / UM}
        findings.append(Finding("cost of linearising", "informs", text, numbers=numbers))
    return findings
