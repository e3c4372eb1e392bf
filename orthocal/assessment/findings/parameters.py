"""What single parameters tell: which must change, which may stay, what holds or hides them."""

from __future__ import annotations

import math
from collections.abc import Sequence

from orthocal.assessment.controller_entries import find_entries
from orthocal.assessment.findings.finding import Finding, places_of
from orthocal.assessment.wording import joined, mm, plain
from orthocal.calibration.calibration import Calibration
from orthocal.statistics.chance import confidence_factor
from orthocal.units import MM

STANDSTILL = 1e-6
"""Part of a tolerance by which a parameter must move to have moved."""

WORTHWHILE = 1.05
"""Times the tool's error to be expected with the offsets entered that it must be without them for
offsets that are less than their ± from what is active to be worth entering."""

FEW_NAMES = 6
"""Parameters up to which all are named."""


def find_standstill(calibration: Calibration) -> list[Finding]:
    """Whether nothing moved, and why."""
    if any(abs(p.value - p.start) > STANDSTILL * p.tolerance for p in calibration.free):
        return []
    numbers = {"before_rms_mm": calibration.rms_before / MM}
    if len(calibration.identifiability.unseen) == len(calibration.free):
        return [
            Finding(
                "nothing moved",
                "informs",
                "Nothing moved: no reading depends on any free parameter, so all stay at their "
                "start.",
                "Read setups and postures that depend on what is to be found.",
                numbers,
                places_of(*(p.name for p in calibration.free)),
            )
        ]
    return [
        Finding(
            "nothing moved",
            "informs",
            "Nothing moved: the readings show no deviation that these parameters would explain "
            f"(r.m.s. {mm(calibration.rms_before)} mm before). What the controller has is right, "
            "or the readings are those of a machine without errors.",
            numbers=numbers,
        )
    ]


def find_worth(calibration: Calibration, at_tool: Sequence[Finding]) -> list[Finding]:
    """Whether entering would do more than exchange one value for another within its ±.

    Args:
        calibration: The calibration.
        at_tool: What the tool is good for, where that is known.
    """
    entries = [e for e in find_entries(calibration) if e.held is None]
    if not entries or not all(abs(e.change) <= e.std for e in entries):
        return []
    ratios = [abs(e.change) / e.std for e in entries if e.std > 0.0]
    numbers = {"largest_change_over_std": max(ratios, default=0.0)}
    words = ""
    for found in at_tool:
        now, expected = (found.numbers[k] for k in ("expected_as_it_is_um", "expected_um"))
        if not now <= WORTHWHILE * expected:
            return []
        words = ", and to enter them would not make the tool better"
        numbers |= {"expected_as_it_is_um": now, "expected_um": expected}
    return [
        Finding(
            "nothing worth changing",
            "informs",
            f"No offset differs by more than its ± from what the controller has{words}.",
            "Leave the offsets as they are.",
            numbers,
            places_of(*(e.drive for e in entries)),
        )
    ]


def find_trust(calibration: Calibration) -> list[Finding]:
    """Which offsets are proved, errors that were not identified taken at their tolerances."""
    k = calibration.confidence_factor
    if math.isinf(k) or math.isnan(calibration.sigma) or calibration.noise.source == "gauge":
        return []
    normal = confidence_factor(math.inf)
    clear: list[str] = []
    vague: list[str] = []
    for e in find_entries(calibration):
        if e.held is None:
            rest = math.sqrt(max(e.std**2 - e.scatter**2, 0.0))
            proved = abs(e.change) > math.hypot(k * e.scatter, normal * rest)
            (clear if proved else vague).append(e.drive)
    found = []
    if clear:
        text = f"Offsets that must change (95 %, with all that is not known): {', '.join(clear)}."
        found.append(Finding("must change", "informs", text, places=places_of(*clear)))
    if vague:
        text = (
            f"Offsets that might as well stay as they are (their 95 % interval, with all that is "
            f"not known, includes no change): {', '.join(vague)}. The values are still the best "
            "estimate."
        )
        found.append(Finding("may stay", "informs", text, places=places_of(*vague)))
    return found


def find_held(calibration: Calibration) -> list[Finding]:
    """Parameters that a bound holds; offsets that are held so are to be looked at first."""
    known = calibration.robot.parameters
    found = []
    for p in calibration.free:
        if p.at_bound is None:
            continue
        found.append(
            Finding(
                "held by a bound",
                "warns" if known.are_offsets(p.name) else "informs",
                f"{p.name} is held by its {p.at_bound} bound, {p.value * p.edge_factor:g} "
                f"{p.edge_unit}. The readings want it beyond; it has no ± of its own, and the "
                "others' ± holds with it there.",
                "Make sure that this bound is meant.",
                {f"value_{p.edge_unit}" if p.unit != "1" else "value": p.value * p.edge_factor},
                places_of(p.name),
            )
        )
    return found


def find_linearisation(calibration: Calibration) -> list[Finding]:
    """What the linear equations would have cost, in the parameter where it is most of its ±."""
    if not calibration.solver.tells_linearisation:
        return []
    shifts = [
        (abs(p.value - p.linear), std, p)
        for p, std in zip(calibration.free, calibration.total_std.tolist(), strict=True)
    ]
    largest, std, p = max(shifts, key=lambda s: s[0] / max(s[1], 1e-300))
    if math.isnan(std) or std <= 0.0:
        return []
    return [
        Finding(
            "cost of linearising",
            "informs",
            f"Linearising costs at most {plain(largest * p.edge_factor)} {p.edge_unit} "
            f"({p.name}), {largest / std:.2g} of its σ.",
            numbers={"part_of_sigma": largest / std},
            places=places_of(p.name),
        )
    ]


def find_hidden(calibration: Calibration) -> list[Finding]:
    """What the readings cannot tell apart, and what they do not see."""
    seen = calibration.identifiability
    found = [
        Finding(
            "not told apart",
            "informs",
            f"Not told apart: {c.words}.",
            places=places_of(*c.names),
        )
        for c in seen.alike
    ]
    if seen.unseen:
        count = len(seen.unseen)
        noun = "parameter" if count == 1 else "parameters"
        named = f" ({', '.join(seen.unseen)})" if count <= FEW_NAMES else ""
        found.append(
            Finding(
                "below the noise",
                "informs",
                f"Below the noise: {count} {noun}, one tolerance of which moves all readings "
                f"together by less{named}.",
                numbers={"parameters": float(count)},
                places=places_of(*seen.unseen),
            )
        )
    return found


def find_controller(calibration: Calibration) -> list[Finding]:
    """Whether the session says which offsets were active."""
    entries = find_entries(calibration)
    if not entries or entries[0].active is not None:
        return []
    return [
        Finding(
            "controller not stated",
            "informs",
            "The session does not state the offsets that were active: there is no `controller`.",
            f"Add these to what is in the controller for {joined([e.drive for e in entries])}.",
        )
    ]
