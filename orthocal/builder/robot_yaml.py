"""YAML of a machine with slides and legs of rods."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from orthocal.builder.dimensions import box_text, in_mm

ROUGH = "offset_mm: 10, translation_mm: 0.2, rotation_mrad: 2, scale_ppm: 200"
"""Tolerances of a machine that was built in a workshop."""

TWO_RODS = {"a": ("{k}_bar_a", "{k}_coupler"), "b": ("{k}_bar_b", "{k}_rod_b_tip")}
"""Frames at both ends of the rods of a parallelogram."""

ONE_ROD = {"a": ("{k}_bar", "{k}_end")}
"""Frames at both ends of a single rod."""


MODELS = {"offsets": ("*.offset",), "lengths": ("*.offset", "*_leg.length")}
"""Free errors of the models of every machine, besides full."""


@dataclass(frozen=True, slots=True)
class Loop:
    """A loop closure."""

    name: str
    frames: tuple[str, str]
    kind: str = "3d"
    rows: tuple[str, ...] = ()
    """All by default."""


def platform_loops(letters: str) -> list[Loop]:
    """Loops of a machine whose legs are parallelograms that carry a platform in space.

    Args:
        letters: Names of the legs; the first one carries the platform.
    """
    return [
        *(parallelogram_loop(k) for k in letters),
        *(Loop(f"{k}_platform", ("platform", f"{k}_foot_end"), "6d") for k in letters[1:]),
    ]


def parallelogram_loop(k: str) -> Loop:
    """Loop of a leg of two rods, which is planar."""
    return Loop(f"{k}_parallelogram", (f"{k}_crossbar_end", f"{k}_rod_b_tip"), "3d", ("x", "z"))


def length_sums(letters: str) -> dict[str, list[str]]:
    """Lengths of legs of two rods as named sums: both rods get longer together."""
    return {f"{k}_leg.length": [f"{k}_coupler.x", f"frame.{k}_rod_b_tip.x"] for k in letters}


def robot_yaml(
    title: str,
    *,
    letters: str,
    zero: float,
    rod_radius: float,
    loops: Sequence[Loop],
    parameters: Mapping[str, Sequence[str]],
    models: Mapping[str, Sequence[str]] | None = None,
    rods: Mapping[str, tuple[str, str]] = TWO_RODS,
    tip: str = "{k}_leg_tip",
    coordinates: str = "xyz",
    workspace: Sequence[Sequence[float]] | None = None,
    tolerances: str = ROUGH,
) -> str:
    """YAML of a machine.

    Args:
        title: Comment in the first line.
        letters: Names of the legs.
        zero: Coordinate of the slides in the mechanical zero, [m].
        rod_radius: Radius of a rod, [m].
        loops: Loop closures.
        parameters: Named sums of errors.
        models: Free errors of models besides offsets, lengths and full.
        rods: Frames at both ends of each rod of a leg k.
        tip: Frame at the end of a leg k.
        coordinates: Coordinates of the tool that the drives control.
        workspace: Limits, [m].
        tolerances: Tolerances as YAML.
    """
    usual = {**MODELS, **(models or {})}
    box = [] if workspace is None else [f"  workspace: {{box_mm: {box_text(workspace)}}}"]
    lines = [
        f"# {title}",
        *_gepetto_lines(letters, loops),
        "orthocal:",
        *box,
        "  # One entry for each pair of closed_loop, in its order. Rows that depend on others are",
        "  # omitted, as in planar loops.",
        "  closures:",
        *(f"    {loop.name}: {{{_rows(loop.rows)}}}" for loop in loops),
        "  # Coordinates of the slides in the mechanical zero.",
        "  drives:",
        *(f"    {k}_slide: {{zero_mm: {in_mm(zero)}}}" for k in letters),
        "  # The line of each leg, and its rods, which a gauge touches.",
        "  legs:",
        *(line for k in letters for line in _leg_lines(k, tip, rods, in_mm(rod_radius))),
        f"  tcp: {{frame: tcp, coordinates: [{', '.join(coordinates)}]}}",
        "  # Named sums of elementary errors; '-' subtracts.",
        "  parameters:",
        *(f"    {name}: [{', '.join(members)}]" for name, members in parameters.items()),
        "  # Limits of the errors before the calibration: 19 of 20 errors are within them.",
        f"  tolerances: {{{tolerances}}}",
        "  # Free errors of each model. complete: every error that moves a rod or the tool.",
        "  models:",
        *(f"    {name}: [{', '.join(map(repr, globs))}]" for name, globs in usual.items()),
        "    full: complete",
    ]
    return "\n".join(lines) + "\n"


def _gepetto_lines(letters: str, loops: Sequence[Loop]) -> list[str]:
    return [
        "# Loops and drives, in the keys of the Gepetto extended URDF.",
        "closed_loop:",
        *(f"  - [{', '.join(loop.frames)}]" for loop in loops),
        f"type: [{', '.join(loop.kind for loop in loops)}]",
        f"name_mot: [{', '.join(f'{k}_slide' for k in letters)}]",
        "",
    ]


def _rows(rows: Sequence[str]) -> str:
    return f"rows: [{', '.join(rows)}]" if rows else ""


def _leg_lines(k: str, tip: str, rods: Mapping[str, tuple[str, str]], radius: str) -> list[str]:
    """YAML of a leg k with rods of a radius, in mm."""
    ends = {name: [frame.format(k=k) for frame in frames] for name, frames in rods.items()}
    return [
        f"    {k}:",
        f"      root: {k}_leg_root",
        f"      tip: {tip.format(k=k)}",
        "      rods:",
        *(
            f"        {name}: {{root: {root}, tip: {end}, radius_mm: {radius}}}"
            for name, (root, end) in ends.items()
        ),
    ]
