"""What is said while a session is measured: plain text, as wide as there is room."""

from __future__ import annotations

import shlex
import textwrap
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from orthocal.assessment.wording import counted, joined
from orthocal.measurement.motion.motion import Guidance
from orthocal.measurement.recording.anomalies import Oddity, Slip
from orthocal.measurement.recording.recording import Recording, Row
from orthocal.session.session import Session, Setup
from orthocal.text import printable
from orthocal.units import DRIVE_UNITS, MM, to_mm

Array = NDArray[np.float64]

GLUE = "\u00a0"
"""Between words that stay on one line."""

SLIPS: dict[Slip, str] = {
    "": "",
    "sign": " With the other sign it would fit.",
    "too large": " With the decimal point one place further left it would fit.",
    "too small": " With the decimal point one place further right it would fit.",
}

COMMANDS = {
    "back": "to the row above; `back 3` to row 3: type what it should be",
    "again": "read the last row once more, as another cycle; `again 3` row 3",
    "skip": "leave this row empty for now",
    "drop": "take this row out: it will not be read; `drop 3` row 3",
    "restart": "read all of this setup anew, if stand or dial has moved",
    "list": "all rows and their readings",
    "show": "this setup and posture once more",
    "help": "these words",
    "quit": "leave; all readings are kept, and the same command goes on",
}
"""What may be typed instead of a reading; any beginning of it that is no other's will do."""


def wrap(text: str, width: int, *, indent: str = "", first: str | None = None) -> str:
    """A paragraph in lines of at most so many columns."""
    lines = textwrap.wrap(
        printable(text, keep=GLUE),
        max(width, 20),
        initial_indent=indent if first is None else first,
        subsequent_indent=indent,
    )
    return "\n".join(lines).replace(GLUE, " ")


def show_mm(value: float) -> str:
    """A reading in mm, with as many decimals as it has; two at least."""
    whole, _, decimals = f"{to_mm(value) + 0.0:.6f}".partition(".")
    return f"{whole}.{decimals.rstrip('0').ljust(2, '0')}"


def _decimal(value: float, decimals: int = 3) -> str:
    """A number whose zero has no sign."""
    return f"{round(float(value), decimals) + 0.0:.{decimals}f}"


def describe_session(recording: Recording, *, width: int) -> str:
    """What there is to measure."""
    session, rows, redone = recording.session, recording.rows, recording.redone
    done = sum(row.value is not None for row in rows)
    title = f"{session.title}: " if session.title else ""
    count = counted(len({r.setup for r in rows}), "setup")
    state = "nothing is read yet" if not done else f"{done} of them are there"
    parts = [f"{title}{counted(len(rows), 'reading')} in {count} on {session.robot.name}; {state}."]
    if redone:
        parts.append(
            f"The last recording was cut off; {counted(redone, 'change')} of it "
            f"{'was' if redone == 1 else 'were'} restored."
        )
    if recording.edited:
        parts.append(
            f"{recording.path.name} was changed since the last recording was cut off; it counts as "
            "it is."
        )
    parts.append(
        "Type what the dial shows, in mm; it is on disk before the next question. `help` lists "
        "what else can be typed."
    )
    parts.append("Approach every posture from the same side, from a millimetre before it.")
    return "\n".join(wrap(part, width) for part in parts)


def describe_setup(
    session: Session, guidance: Guidance, rows: Sequence[Row], name: str, *, width: int
) -> str:
    """Where the gauge goes, and what to do with its dial."""
    setup = session.setups[name]
    names = list(dict.fromkeys(r.setup for r in rows))
    own = [r for r in rows if r.setup == name]
    lines = [
        wrap(
            f"Setup {name}, {names.index(name) + 1} of {len(names)}: "
            f"{counted(len(own), 'reading')}",
            width,
        )
    ]
    begin = own[0].minus or own[0].posture
    parts = [f"Read: {setup.sensor.describe()}", _stand(guidance, name, begin)]
    parts += [_gauge(session, setup)]
    if all(r.minus is not None for r in own):
        parts.append(
            "Each row is a difference: read in its first posture less read in its second. Touch "
            "neither stand nor dial between the two."
        )
    elif any(r.value is not None for r in own):
        parts.append(
            "There are readings of this setup: neither stand nor dial may have moved since. If one "
            "has, `restart` and read all of it anew."
        )
    else:
        parts.append(
            f"Go to {begin} and set the dial to {_middle(session, setup)} there. From then on "
            "touch neither stand nor dial until the setup is done."
        )
    lines += [wrap(part, width, indent="  ") for part in parts if part]
    return "\n".join(lines)


def _stand(guidance: Guidance, setup: str, posture: str) -> str:
    direction = guidance.contacts[setup][1].direction
    at = ", ".join(f"{_decimal(v / MM, 1)}" for v in guidance.touched(setup, posture))
    side = _way(direction)
    return (
        f"Stand: on the {side} side, so that the tip touches at ({at}) mm in {posture}. Push the "
        f"plunger in by hand: the dial has to grow, as it does where the machine moves to {side}."
    )


def _way(direction: Array) -> str:
    """A direction in words: an axis with its sign, or a vector."""
    axis = int(np.abs(direction).argmax())
    if abs(direction[axis]) > 1.0 - 1e-9:
        return ("+" if direction[axis] > 0.0 else "-") + "xyz"[axis]
    return f"({', '.join(f'{_decimal(v, 2)}' for v in direction)})"


def _gauge(session: Session, setup: Setup) -> str:
    gauge = session.gauges[setup.gauge]
    facts = []
    if gauge.range is not None:
        facts.append(f"{gauge.range[0] / MM:g} to {gauge.range[1] / MM:g} mm")
    if gauge.resolution is not None:
        facts.append(f"resolution {gauge.resolution / MM:g} mm")
    name = f" {setup.gauge}" if setup.gauge else ""
    return f"Dial{name}: {', '.join(facts)}" if facts or name else ""


def _middle(session: Session, setup: Setup) -> str:
    limits = session.gauges[setup.gauge].range
    if limits is None:
        return "the middle of its range"
    return f"about {0.5 * (limits[0] + limits[1]) / MM + 0.0:g} mm, the middle of its range,"


def describe_row(
    session: Session, guidance: Guidance, rows: Sequence[Row], index: int, *, width: int
) -> str:
    """Which reading comes next, and where the machine goes for it."""
    row = rows[index]
    lines = [
        wrap(f"{index + 1} of {len(rows)} (line {index + 2} of the table): {row.label}", width)
    ]
    for posture in (row.posture, *([row.minus] if row.minus else [])):
        name = f"{posture}: " if row.minus else ""
        lines.append(_coordinates(session, guidance, posture, name, width))
    if row.value is not None:
        lines.append(wrap(f"It is {show_mm(row.value)} mm; Enter keeps it.", width, indent="  "))
    return "\n".join(lines)


def _coordinates(session: Session, guidance: Guidance, posture: str, name: str, width: int) -> str:
    parts = []
    for drive, value in zip(session.robot.drives, guidance.joints[posture], strict=True):
        unit, size = DRIVE_UNITS[drive.unit]
        parts.append(f"{drive.name} {_decimal(value / size)} {unit}".replace(" ", GLUE))
    lines = [wrap(f"{name}joints {', '.join(parts)}", width, indent="  ")]
    if posture in guidance.tool:
        values = zip("xyz", guidance.tool[posture], strict=True)
        tool = ", ".join(f"{axis}{GLUE}{_decimal(v / MM)}" for axis, v in values)
        lines.append(wrap(f"{name}tool {tool}{GLUE}mm", width, indent="  "))
    return "\n".join(lines)


def acknowledge(rows: Sequence[Row], index: int, *, width: int) -> str:
    """That a reading is on disk."""
    row = rows[index]
    value = "" if row.value is None else show_mm(row.value)
    return wrap(f"Kept: row {index + 1}, {row.label}: {value} mm", width, indent="  ")


def describe_oddity(oddity: Oddity, row: Row, guidance: Guidance, *, width: int) -> str:
    """What is odd about a reading that was kept."""
    value = row.value or 0.0
    off, expected = f"{abs(oddity.off(value)) / MM:.3f} mm", f"{_decimal(oddity.expected / MM)}"
    if oddity.kind == "resolution":
        text = (
            f"{show_mm(value)} mm is no multiple of the dial's resolution, "
            f"{oddity.spread / MM:g} mm."
        )
    elif oddity.kind == "cycles":
        text = (
            f"It is {off} from its other cycles ({expected} mm): more than the dial's noise "
            f"explains.{SLIPS[oddity.slip]} Read it once more: `again`."
        )
    elif oddity.kind == "drift":
        text = (
            f"It is {off} from what {oddity.setup} showed here at first ({expected} mm): stand or "
            "dial has moved, or the machine has become warmer, or one of the two is mistyped."
            f"{SLIPS[oddity.slip]} If it stays so on a second look, `restart`."
        )
    elif oddity.kind == "unexpected":
        text = (
            f"It is {off} from what the other readings let expect, {expected} ± "
            f"{oddity.spread / MM:.3f} mm; or one of them is wrong, the first of this setup for "
            f"instance.{SLIPS[oddity.slip]}"
        )
    else:
        side = _way(guidance.contacts[oddity.setup][1].direction)
        text = (
            f"The readings of {oddity.setup} fit far better with the other sign: is the dial "
            f"turned round, or does the stand look from the other side? It belongs on the {side} "
            "side; pushed in by hand the plunger makes the dial grow."
        )
    return wrap(f"{text} It is kept as it is; `back` corrects it.", width, indent="  ", first="! ")


def list_rows(rows: Sequence[Row], *, width: int) -> str:
    """All rows, and what was read."""
    last = len(str(len(rows)))
    return "\n".join(
        wrap(
            f"{i + 1:>{last}}  {r.label}: ".replace("  ", GLUE * 2)
            + ("not read" if r.value is None else f"{show_mm(r.value)}{GLUE}mm"),
            width,
            indent=" " * (last + 2),
        )
        for i, r in enumerate(rows)
    )


def list_commands(*, width: int) -> str:
    """What can be typed."""
    lines = [
        wrap("A reading in mm, such as -0.12 or -0,12; or", width),
        *(
            wrap(f"{name}: {words}", width, indent="    ", first="  ")
            for name, words in COMMANDS.items()
        ),
        wrap("Ctrl-D and Ctrl-C leave, too. Enter alone keeps what is there.", width),
    ]
    return "\n".join(lines)


def conclude(session: Session, rows: Sequence[Row], path: str, *, width: int) -> str:
    """What is missing, and what comes next: a command on a line of its own, however long it is.

    Args:
        session: What was measured.
        rows: Its readings.
        path: Of the session, as it was typed.
        width: Columns.
    """
    missing = [(i, r) for i, r in enumerate(rows) if r.value is None]
    own = printable(shlex.quote(path))
    if missing:
        parts = []
        for setup in dict.fromkeys(r.setup for _, r in missing):
            of_setup = [i + 1 for i, r in missing if r.setup == setup]
            every = len(of_setup) == sum(r.setup == setup for r in rows)
            places = "all" if every else _spans(of_setup)
            parts.append(f"{setup} {places}")
        state = (
            f"{len(missing)} of {counted(len(rows), 'reading')} "
            f"{'is' if len(missing) == 1 else 'are'} missing: {joined(parts)}."
        )
        return f"{wrap(state, width)}\nGo on with:\n  orthocal record {own}"
    lines = [f"All {counted(len(rows), 'reading')} are there."]
    if session.controller_offsets is None:
        keys = "offsets_mm" if session.robot.drives[0].unit == "m" else "offsets_deg"
        zeros = ", ".join("0" for _ in session.robot.drives)
        lines.append(
            "Say in session.yaml which offsets are active in the controller, such as "
            f"`controller: {{{keys}: [{zeros}]}}`, one number a drive: without it only changes of "
            "them can be told."
        )
    told = "\n".join(wrap(line, width) for line in lines)
    following = f"Next:\n  orthocal calibrate {own}"
    if session.controller_offsets is not None and any(session.controller_offsets):
        following = (
            "Next: whether what was entered is right, by the calibration that it is of,\n"
            f"  orthocal validate CALIBRATION {own}\n"
            f"or what to enter now:\n  orthocal calibrate {own}"
        )
    return f"{told}\n{following}"


def _spans(numbers: Sequence[int]) -> str:
    """Numbers of rows: rows 3, 5 to 8."""
    spans: list[list[int]] = []
    for n in numbers:
        if spans and n == spans[-1][-1] + 1:
            spans[-1] = [spans[-1][0], n]
        else:
            spans.append([n])
    words = [f"{s[0]} to {s[-1]}" if len(s) > 1 else str(s[0]) for s in spans]
    return f"{'row' if len(numbers) == 1 else 'rows'} {', '.join(words)}"
