"""Klipper: settings in printer.cfg, triggers in its log, saved heights and console output.

A stable position is the number of steps of each carriage below its endstop, which does not depend
on the settings. Sources: klippy/extras/delta_calibrate.py, klippy/extras/probe.py.
"""

from __future__ import annotations

import ast
import math
import re
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from orthocal.arrays import Array, triple
from orthocal.errors import SessionError, errors_at
from orthocal.io.documents import LARGEST_NUMBER, parse_number
from orthocal.printers.klipper_print import Distances, has_analysis, read_analysis, saved_distances
from orthocal.printers.log import (
    NUMBER,
    LogText,
    PrinterLog,
    last_probing,
    numbers,
    probed_log,
    require_points,
    unstated_trigger,
    unusual_content,
)
from orthocal.printers.settings import DESIGN_ANGLES, DeltaSettings
from orthocal.text import shorten
from orthocal.units import DEG, MM

DECIMALS = 6
"""Decimals of settings, as Klipper writes them."""

EXPECTED = (
    "the end of klippy.log after DELTA_CALIBRATE, a printer.cfg with a section [delta_calibrate], "
    "or the lines 'probe at X,Y is z=Z' of the console with --settings printer.cfg"
)

PROBES = ("probe", "bltouch", "smart_effector", "probe_eddy_current", "beacon", "cartographer")
"""Kinds of sections with the offsets of a probe; a name may follow in the section's title."""

TOWERS = "abc"
STEPPERS = tuple(f"stepper_{tower}" for tower in TOWERS)
Sections = Mapping[str, Mapping[str, str]]
Pairs = list[tuple[float, tuple[float, float, float]]]
"""Pairs of height, [mm], and stable position, [steps]."""

_RUN = re.compile(
    r"Calculating delta_calibrate with:\n(?P<heights>\[.*\])\n(?P<distances>\[.*\])\n"
    r"Initial delta_calibrate parameters: (?P<parameters>\{.*\})"
)
_OLD_PROBE = re.compile(rf"probe at ({NUMBER}),({NUMBER}) is z=({NUMBER})")
_ANY_PROBE = re.compile(r"probe:? at [^\n]{0,60} (?:is|bed will contact at) z=[^\n]{0,40}")
_NEW_PROBE = re.compile(rf"probe: at ({NUMBER}),({NUMBER}) bed will contact at z=({NUMBER})")


def recognise(text: str) -> bool:
    """True if a text is certainly from Klipper."""
    return bool(
        re.search(r"delta_calibrate|^\[stepper_a\]", text, re.MULTILINE)
        or _OLD_PROBE.search(text)
        or _NEW_PROBE.search(text)
    )


def read_log(source: LogText) -> PrinterLog:
    """Read settings, triggers and printed distances.

    Raises:
        SessionError: If the text is invalid; names the key or line.
    """
    log = _read_heights(source)
    printed = read_analysis(source, log.settings)
    return replace(log, distances=printed) if printed else log


def _read_heights(source: LogText) -> PrinterLog:
    """Settings, triggers and saved distances.

    Heights that were saved in the log count if no line of the probe follows them. Those of a file
    with settings count only for distances of a print, in a log without heights.

    Raises:
        SessionError: If a line of the probe is damaged, or there are too few points.
    """
    text = source.text
    files = " and ".join(name for name, _ in source.files)
    if runs := list(_RUN.finditer(text)):
        begin = runs[-1].start()
        probe = _probe_offset(_sections_before(text, begin), files)
        with errors_at(source.place(begin)):
            return _read_run(runs[-1], probe)
    matches = sorted(
        [*_OLD_PROBE.finditer(text), *_NEW_PROBE.finditer(text)], key=lambda m: m.start()
    )
    _require_points(source)
    begin = 0 if has_analysis(source) and not matches else source.begin
    steps = _saved_heights(_sections(text[begin:]), source.name)
    notes = []
    if steps is not None and matches and _first_saved(text) < matches[-1].start():
        notes.append(f"{len(steps[0])} saved heights are not used: they are older.")
    elif steps is not None:
        sections = _sections(text)
        settings = _settings(sections, files)
        return _log_from_steps(*steps, settings, _step_lengths(sections, files))
    points = np.array([_probed(m, source) for m in matches]).reshape(-1, 3) * MM
    positions = [m.start() for m in matches]
    used, of_probings = last_probing(points, positions, source)
    notes += of_probings
    sections = _sections_before(text, positions[used.stop - 1] if positions else len(text))
    settings = _settings(sections, files)
    contacts = [m.re is _NEW_PROBE for m in matches]  # newer versions print the point of contact
    points -= np.outer(contacts, settings.probe)
    name = _probe_section(sections)
    if "z_offset" not in sections.get(name, {}):
        notes.append(unstated_trigger(f"z_offset in [{name}]"))
    return probed_log(settings, points[used], expected=EXPECTED, notes=notes)


def _first_saved(text: str) -> int:
    """Position at which the last saved heights are for the first time: each start prints them."""
    last = text[text.rfind("height0_pos") :]
    return text.find(last.partition("\n")[0])


def _require_points(source: LogText) -> None:
    """Refuse lines of the probe without three numbers.

    Raises:
        SessionError: If there is one; names its line.
    """
    for line in _ANY_PROBE.finditer(source.text, source.begin):
        if _OLD_PROBE.match(line[0]) or _NEW_PROBE.match(line[0]):
            continue
        raise SessionError(
            f"found '{shorten(line[0])}'; expected numbers with a decimal point, such as "
            "'probe at 10.0,20.0 is z=1.25'",
            where=source.place(line.start()),
        )


def _probed(match: re.Match[str], source: LogText) -> list[float]:
    """Coordinates of a line of the probe, [mm]."""
    line = source.place(match.start())
    if re.match(r",\d", match.string[match.end() :]):
        raise SessionError(
            f"found '{match[0]}' with a decimal comma; expected a decimal point", where=line
        )
    return numbers(match.groups(), where=line, name="probe")


_DAMAGED = (
    ValueError,
    SyntaxError,
    TypeError,
    KeyError,
    AttributeError,
    MemoryError,
    OverflowError,
)
"""Errors that a damaged calculation can raise."""


def _require_plausible(*values: object) -> None:
    """Raise ValueError if a number in nested lists is not finite, or beyond LARGEST_NUMBER."""
    for value in values:
        if isinstance(value, list | tuple):
            _require_plausible(*value)
        elif not abs(float(str(value))) <= LARGEST_NUMBER:
            raise ValueError


def _read_run(run: re.Match[str], probe: Array) -> PrinterLog:
    """Settings and triggers of a calculation in klippy.log."""
    try:
        heights, lengths, values = (ast.literal_eval(v) for v in run.groups())
        distances = [(float(d), [[*map(float, p)], [*map(float, q)]]) for d, p, q in lengths]
        pairs = [(float(h), (float(a), float(b), float(c))) for h, (a, b, c) in heights]
        value = {name: float(v) for name, v in values.items()}
        settings = _with_endstops(
            value["radius"],
            [value[f"arm_{k}"] for k in TOWERS],
            [value[f"angle_{k}"] for k in TOWERS],
            [value[f"endstop_{k}"] for k in TOWERS],
            probe,
        )
        steps = np.array([value[f"stepdist_{k}"] for k in TOWERS]) * MM
        _require_plausible(pairs, distances, [*value.values()])
    except _DAMAGED as e:
        raise SessionError(
            f"the calculation of delta_calibrate is damaged ({type(e).__name__}); expected lists "
            "of heights, distances and parameters as Klipper writes them"
        ) from None
    # heights of the probe follow the manual ones, and all are its z_offset
    manual = [pair for pair in pairs if pair[0] != pairs[-1][0]]
    probed = [pair for pair in pairs if pair[0] == pairs[-1][0]]
    return _log_from_steps(probed, manual, distances, settings, steps)


def _log_from_steps(
    pairs: Pairs,
    manual: Pairs,
    distances: Distances,
    settings: DeltaSettings,
    steps: Array,
) -> PrinterLog:
    """Log from stable positions.

    Args:
        pairs: Heights of the probe and stable positions.
        manual: Manual heights of the nozzle and stable positions.
        distances: Saved distances.
        settings: The settings.
        steps: Travel of each carriage per step, shape (3,), [m].
    """
    notes, height = list[str](), settings.probe[2]
    if height and pairs and not pairs[-1][0]:  # METHOD=manual: the nozzle touched the bed
        settings = replace(settings, probe=(0.0, 0.0, height))
    if manual and any(settings.probe[:2]):
        notes.append(
            f"Manual heights are not used ({len(manual)}): the probe is at another place than the "
            "nozzle."
        )
    else:
        pairs = [*manual, *pairs]
    require_points(len(pairs), EXPECTED)
    settings.require_plausible()
    if not settings.probe[2]:  # not stated: the height of the triggers replaces it
        settings = replace(settings, probe=(*settings.probe[:2], -pairs[-1][0] * MM))
    heights = np.array([h for h, _ in pairs]) * MM + settings.probe[2]
    carriages = np.array(settings.homed) - np.array([s for _, s in pairs]) * steps
    return PrinterLog(
        settings,
        carriages,
        heights,
        (*notes, *unusual_content(settings, carriages)),
        saved_distances(settings, steps, distances),
    )


def _saved_heights(sections: Sections, where: str) -> tuple[Pairs, Pairs, Distances] | None:
    """Heights of the probe, manual heights and distances; None without any."""
    saved = sections.get("delta_calibrate", {})
    pairs_by_kind: list[Pairs] = []
    for prefix in ("height", "manual_height"):
        pairs: Pairs = []
        while (key := f"{prefix}{len(pairs)}") in saved:
            a, b, c = _saved_steps(saved, f"{key}_pos", where)
            pairs.append((_number(sections, "delta_calibrate", key, where), (a, b, c)))
        if len(pairs) < sum(re.fullmatch(rf"{prefix}\d+", k) is not None for k in saved):
            raise SessionError(
                "is missing, but a later one is there; expected the complete list that SAVE_CONFIG "
                "writes",
                where=f"{where}: [delta_calibrate] {key}",
            )
        pairs_by_kind.append(pairs)
    distances: Distances = []
    while (key := f"distance{len(distances)}") in saved:
        ends = [_saved_steps(saved, f"{key}_pos{i}", where) for i in (1, 2)]
        distances.append((_number(sections, "delta_calibrate", key, where), ends))
    return (pairs_by_kind[0], pairs_by_kind[1], distances) if pairs_by_kind[0] else None


def _saved_steps(saved: Mapping[str, str], key: str, where: str) -> list[float]:
    """Stable position of a key."""
    with errors_at(f"{where}: [delta_calibrate] {key}"):
        position = numbers(saved.get(key, "").split(","), name="steps")
        if len(position) != 3:
            raise SessionError(f"found {len(position)} numbers; expected 3")
    return position


def _settings(sections: Sections, where: str) -> DeltaSettings:
    """Settings of the sections [printer] and [stepper_a] to [stepper_c].

    The defaults of arm_length and position_endstop are those of tower a.
    """
    kinematics = sections.get("printer", {}).get("kinematics", "delta")
    if kinematics != "delta":
        raise SessionError(
            f"found '{shorten(kinematics)}'; expected delta",
            where=f"{where}: [printer] kinematics",
        )
    for name in STEPPERS:
        if name not in sections:
            raise SessionError(f"has no section [{name}]; expected {EXPECTED}", where=where)
    filled = {
        **sections,
        **{name: {**sections[STEPPERS[0]], **sections[name]} for name in STEPPERS},
    }
    rods, endstops = (
        [_number(filled, name, key, where) for name in STEPPERS]
        for key in ("arm_length", "position_endstop")
    )
    angles = [
        _number(sections, name, "angle", where, default=design / DEG)
        for name, design in zip(STEPPERS, DESIGN_ANGLES, strict=True)
    ]
    radius = _number(sections, "printer", "delta_radius", where)
    with errors_at(where):
        return _with_endstops(radius, rods, angles, endstops, _probe_offset(sections, where))


def _with_endstops(
    radius: float,
    rods: list[float],
    angles: list[float],
    endstops: list[float],
    probe: Array,
) -> DeltaSettings:
    """Settings from Klipper's values in mm and degrees; the probe is in m."""
    for rod, k in zip(rods, TOWERS, strict=True):
        if not 0.0 < radius < rod:
            raise SessionError(
                f"delta_radius is {radius:g}, arm_length of tower {k} {rod:g}; expected a positive "
                "radius and longer rods"
            )
    homed = [e + math.sqrt(rod**2 - radius**2) for e, rod in zip(endstops, rods, strict=True)]
    return DeltaSettings(
        "klipper",
        radius * MM,
        triple(rods, MM),
        triple(homed, MM),
        triple(angles, DEG),
        probe=triple(probe),
    )


def _probe_offset(sections: Sections, where: str) -> Array:
    """Position of the probe's tip at the trigger relative to the nozzle, (3,), [m]; default 0."""
    name = _probe_section(sections)
    x, y, z = (_number(sections, name, f"{axis}_offset", where, default=0.0) for axis in "xyz")
    return np.array([x, y, 0.0 - z]) * MM


def _probe_section(sections: Sections) -> str:
    """Name of the first section of a probe; probe without one."""
    return next((name for name in sections if name.split(" ")[0] in PROBES), "probe")


def _step_lengths(sections: Sections, where: str) -> Array:
    """Travel of each carriage per step, shape (3,), [m]."""
    lengths = []
    for name in STEPPERS:
        if "step_distance" in sections[name]:
            lengths.append(_number(sections, name, "step_distance", where))
            continue
        distance = _number(sections, name, "rotation_distance", where)
        microsteps = _number(sections, name, "microsteps", where)
        steps = _number(sections, name, "full_steps_per_rotation", where, default=200.0)
        gears = re.findall(rf"({NUMBER})\s*:\s*({NUMBER})", sections[name].get("gear_ratio", ""))
        ratio = math.prod(float(a) / float(b) for a, b in gears if float(b))
        if not distance * microsteps * steps * ratio > 0.0:
            raise SessionError("expected positive numbers", where=f"{where}: [{name}]")
        lengths.append(distance / (microsteps * steps * ratio))
    return np.array(lengths) * MM


def _number(
    sections: Sections, section: str, key: str, where: str, *, default: float | None = None
) -> float:
    """Number of a key.

    Raises:
        SessionError: If the key is missing or not a number.
    """
    keys, where = sections.get(section, {}), f"{where}: [{section}]"
    if key in keys:
        return parse_number(keys[key], where=where, name=key, error=SessionError)
    if default is None:
        raise SessionError(f"has no {key}; expected a number", where=where)
    return default


def _sections(text: str) -> dict[str, dict[str, str]]:
    """Sections of a printer.cfg; keys saved at its end replace earlier ones."""
    sections: dict[str, dict[str, str]] = {}
    current: dict[str, str] = {}
    for line in text.splitlines():
        bare = re.sub(r"(^|\s)[#;].*", "", re.sub(r"^#\*# ?", "", line)).strip()
        if head := re.fullmatch(r"\[([^\[\]]+)\]", bare):
            current = sections.setdefault(head[1].strip(), {})
        elif pair := re.fullmatch(r"(\w+)\s*[:=]\s*(.*)", bare):
            current[pair[1]] = pair[2]
    return sections


def _sections_before(text: str, position: int) -> dict[str, dict[str, str]]:
    """Settings before a position, as each start prints them; all if those before are incomplete."""
    before = _sections(text[:position])
    return before if "stepper_a" in before else _sections(text)


def config_lines(settings: DeltaSettings) -> str:
    """Lines of printer.cfg."""
    lines = ["[printer]", f"delta_radius: {settings.radius / MM:.{DECIMALS}f}"]
    towers = zip(TOWERS, settings.endstops, settings.rods, settings.angles, strict=True)
    for k, endstop, rod, angle in towers:
        lines += [
            "",
            f"[stepper_{k}]",
            f"position_endstop: {endstop / MM:.{DECIMALS}f}",
            f"arm_length: {rod / MM:.{DECIMALS}f}",
            f"angle: {angle / DEG:.{DECIMALS}f}",
        ]
    return "\n".join(lines) + "\n"
