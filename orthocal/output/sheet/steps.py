"""Steps before the readings of a setup, and the check after them."""

from __future__ import annotations

import numpy as np

from orthocal.assessment.wording import name_direction
from orthocal.io.html import paragraph
from orthocal.measurement.motion.guidance import dial_zero, range_of_expected, set_dial, shown_tool
from orthocal.measurement.motion.stops import SetupMotion, Stop
from orthocal.observation.gauge_noise import usual_difference
from orthocal.output.sheet.coordinates import show_length, show_number, shown_place
from orthocal.output.sheet.gauge_position import (
    ABOUT_ALONG,
    DIAL_LENGTH,
    GaugePosition,
    name_tip,
)
from orthocal.sensors.ball_bar import BallBar
from orthocal.sensors.points import Points
from orthocal.sensors.protocol import has_dial, mounting_steps, probing_direction
from orthocal.session.session import Session, Setup
from orthocal.units import MM

VISIBLE = 5e-5
"""Smallest distance that the sheet mentions and smallest deflection that a dial shows, [m]."""


def compare_closing(session: Session, motion: SetupMotion) -> str:
    """Check after the readings of a setup."""
    setup = session.setups[motion.setup]
    if isinstance(setup.sensor, Points):
        return (
            "Compare the points of the first posture with each other. If they differ by more than "
            "the instrument scatters, read this setup again: the instrument or the machine was "
            "displaced. "
        )
    first, last = motion.stops[0], motion.stops[-1]
    if last is first or last.posture != first.posture:
        return ""
    if last.repeats is None or last.approach != first.approach:
        return (
            "The last reading repeats the first posture from another side: backlash may change it. "
        )
    largest = usual_difference(session.gauges[setup.gauge])
    usual = f"{show_length(largest)} mm" if largest else "three steps of the dial"
    reading = "0" if first.role == "subtracted" else f"that of line {last.repeats}"
    return (
        f"Compare the closing (last) reading with {reading}: posture and approach are the same. If "
        f"they differ by more than {usual}, read this setup again: the gauge or the machine was "
        "displaced. "
    )


def list_steps(session: Session, motion: SetupMotion, gauge: GaugePosition) -> list[str]:
    """Steps before the readings of a setup."""
    first = motion.stops[0]
    go = [f"Move to the first posture, {first.posture}: {shown_place(session, first.drives)}."]
    align = "Move to the alignment posture"
    if gauge.alignment == first.posture:
        align, go = f"{align}, which is also the first posture", []
    to_alignment = [
        f"{align}, {gauge.alignment}: {shown_place(session, gauge.drives)}."
        f"{_around_ball(session, gauge.setup, motion.alignment or first)}"
    ]
    if probing_direction(gauge.setup.sensor) is not None:  # nothing is aligned on the surface
        to_alignment, go = [], []
    return [
        *to_alignment,
        *(mounting_steps(gauge.setup.sensor) or _mount_on_base(gauge)),
        *go,
        _gauge_zero(session, gauge.setup, first),
        "Take the readings in the order below. The line numbers are those of readings.csv.",
    ]


def _mount_on_base(gauge: GaugePosition) -> tuple[str, ...]:
    """Steps that mount an indicator on the base."""
    side = name_direction(gauge.contact.direction)
    opposite = name_direction(-gauge.contact.direction)
    place = " ".join(
        f"{letter}{show_number(v / MM, 1)}"
        for letter, v in zip("XYZ", gauge.coordinates, strict=True)
    )
    contact = ""
    if gauge.rod is not None and gauge.leg is not None:
        target = f"rod {gauge.rod.name} of leg {gauge.leg.name}"
        reach = gauge.hinge_distances / MM
        contact = (
            f"Its {name_tip(gauge.tip)} touches {_across(gauge)}, {_from_hinge(gauge)}. Then the "
            "rod slides past the tip: during the setup the distance becomes "
            f"{reach.min():.0f} to {reach.max():.0f} mm. "
        )
        if gauge.tip is not None and gauge.tip.edge is None:
            contact += "Align the ball by eye: half a millimetre is good enough. "
    elif gauge.leg is not None:
        target = f"leg {gauge.leg.name}"
        contact = (
            "The calculation assumes that it reads the line between the rods. If its tip touches a "
            "rod, state `touches` and `tip` in session.yaml. "
        )
    else:
        target = " ".join(gauge.setup.sensor.place).strip()
    return (
        f"Mount the gauge on the base, on the {side} side of {target}. Point its plunger to "
        f"{opposite}. {contact}In coordinates, from {gauge.origin_name} in this posture, "
        f"the contact point is at {place} mm.",
        f"Push the plunger in with a finger, towards {side}. The reading must grow. If it falls, "
        "enter every reading of this setup with the opposite sign.",
    )


def _from_hinge(gauge: GaugePosition) -> str:
    """Distance of the contact from the hinge at the drive, now and in the mechanical zero."""
    at, at_zero = gauge.hinge_distances[gauge.aligned], gauge.zero_distance
    words = f"{at / MM:.1f} mm from the hinge on the {gauge.driven_noun}"
    if at_zero is None or abs(at - at_zero) < VISIBLE:
        return words
    return f"{words} (at the mechanical zero it would be {at_zero / MM:.1f} mm)"


def _around_ball(session: Session, setup: Setup, begin: Stop) -> str:
    """Way to the alignment posture past a fixed ball, which may stand at the mechanical zero."""
    if not isinstance(setup.sensor, BallBar) or begin.point is None:
        return ""
    at = ", ".join(show_length(v) for v in shown_tool(session, begin.point[None])[0])
    return (
        " If the fixed ball is in place already, jog around ball and post to this posture (tool at "
        f"{at} mm) before you start."
    )


def _across(gauge: GaugePosition) -> str:
    """Lateral position of the tip on the rod in the alignment posture."""
    offset = float(np.linalg.norm(gauge.lateral_offset))
    if offset <= VISIBLE:
        return "the rod on its centre line"
    return (
        f"the rod with its centre {offset / MM:.1f} mm off the centre line, towards "
        f"{name_direction(gauge.lateral_offset, cosine=ABOUT_ALONG)}"
    )


def _gauge_zero(session: Session, setup: Setup, first: Stop) -> str:
    """Instruction for setting the gauge zero."""
    if setup.zero == "known" or not has_dial(setup.sensor):
        return set_dial(session, setup.name)
    again = " Set it again where the table says so." * (first.role == "subtracted")
    held_by = "stand" if mounting_steps(setup.sensor) is None else "holder"
    held_by = "post" if isinstance(setup.sensor, BallBar) else held_by
    return (
        f"{set_dial(session, setup.name)} This is the gauge zero: set it here only.{again} Push "
        f"the {held_by} lightly and release it: the hand must return to "
        f"{dial_zero(session.gauges[setup.gauge])} within one step."
    )


def setup_warnings(session: Session, motion: SetupMotion, gauge: GaugePosition) -> str:
    """Paragraphs with warnings before the readings of a setup."""
    texts = []
    if gauge.rod is not None and gauge.facing is not None:
        rod, room = gauge.facing
        texts.append(
            f"The gauge is between rods {gauge.rod.name} and {rod.name}, with {room / MM:.0f} mm "
            f"for dial and plunger. A dial indicator needs about {DIAL_LENGTH / MM:.0f} mm. If "
            f"yours does not fit, touch rod {rod.name} instead, from the same side: change "
            "`touches` in session.yaml and run `orthocal sheet`."
        )
    if gauge.near_hinge is not None:
        texts.append(
            f"The tip comes within {gauge.near_hinge / MM:.1f} mm of the middle of a hinge. Check "
            "that it clears the bearing before you set the gauge zero."
        )
    low, high = range_of_expected(
        session.gauges[session.setups[motion.setup].gauge],
        differences=motion.stops[0].role == "subtracted",
    )
    beyond = [s for s in motion.stops if s.role == "reading" and not low <= s.expected <= high]
    if beyond:
        texts.append(
            "Even a perfect machine shows "
            f"{show_number(beyond[0].expected / MM, 1, sign=True)} mm in {beyond[0].label}, "
            "beyond the range of the dial. Choose another posture or another dial."
        )
    if motion.lifting:
        texts.append(motion.lifting)
    return "".join(paragraph(text, kind="warn") for text in texts)
