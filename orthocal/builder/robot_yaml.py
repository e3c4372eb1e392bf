"""YAML of a machine with slides and legs of rods."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from orthocal.builder.dimensions import Dimensions, box_text, in_mm

WORKSHOP_TOLERANCES = "offset_mm: 10, translation_mm: 0.2, rotation_mrad: 2, scale_ppm: 200"
"""Default tolerances, of a machine built in a workshop."""

TWO_RODS = {"a": ("{k}_bar_a", "{k}_coupler"), "b": ("{k}_bar_b", "{k}_rod_b_tip")}
"""Frames at both ends of each rod of a parallelogram, by rod; {k} is the leg."""

ONE_ROD = {"a": ("{k}_bar", "{k}_end")}
"""Frames at both ends of a single rod; {k} is the leg."""

BED_COMMENT = "  # No plan and no program moves the tool below the bed."
"""Comment before the key of a bed."""

MODELS = {"offsets": ("*.offset",), "lengths": ("*.offset", "*_leg.length")}
"""Free errors of the models of every machine, except the model full."""


@dataclass(frozen=True, slots=True)
class Loop:
    """A loop closure."""

    name: str
    frames: tuple[str, str]
    """Frames that the closure joins."""
    kind: str = "3d"
    """Kind in the Gepetto extended URDF: 3d or 6d."""
    rows: tuple[str, ...] = ()
    """Constrained rows of the closure; () for all."""


def platform_loops(letters: str) -> list[Loop]:
    """Loops of a spatial machine whose legs are parallelograms.

    Args:
        letters: Names of the legs; the first one carries the platform.
    """
    return [
        *(parallelogram_loop(k) for k in letters),
        *(Loop(f"{k}_platform", ("platform", f"{k}_foot_end"), "6d") for k in letters[1:]),
    ]


def parallelogram_loop(k: str) -> Loop:
    """Planar loop of a leg k with two rods."""
    return Loop(f"{k}_parallelogram", (f"{k}_crossbar_end", f"{k}_rod_b_tip"), "3d", ("x", "z"))


def length_sums(letters: str) -> dict[str, list[str]]:
    """Lengths of legs with two rods as named sums, in which both rods change equally."""
    return {f"{k}_leg.length": [f"{k}_coupler.x", f"frame.{k}_rod_b_tip.x"] for k in letters}


def robot_yaml(
    machine: Dimensions,
    *,
    loops: Sequence[Loop],
    parameters: Mapping[str, Sequence[str]],
    models: Mapping[str, Sequence[str]] | None = None,
    rods: Mapping[str, tuple[str, str]] = TWO_RODS,
    tip: str = "{k}_leg_tip",
    bed: float | None = None,
    tolerances: str = WORKSHOP_TOLERANCES,
) -> str:
    """YAML of a machine.

    Args:
        machine: Dimensions of the machine.
        loops: Loop closures.
        parameters: Named sums of errors.
        models: Free errors of models in addition to offsets, lengths and full.
        rods: Frames at both ends of each rod of a leg k.
        tip: Frame at the end of a leg k.
        bed: Lowest coordinate z of the tool relative to the mechanical zero, [m].
        tolerances: Tolerances as YAML.
    """
    letters = machine.letters
    lines = [
        f"# {machine.title}",
        *_gepetto_lines(letters, loops),
        "orthocal:",
        *_place_lines(machine.box, bed),
        "  # One entry for each pair of closed_loop, in its order. Rows that depend on others are",
        "  # omitted, as in planar loops.",
        "  closures:",
        *(f"    {loop.name}: {{{_rows(loop.rows)}}}" for loop in loops),
        "  # Coordinates of the slides in the mechanical zero.",
        "  drives:",
        *(f"    {k}_slide: {{zero_mm: {in_mm(machine.zero)}}}" for k in letters),
        "  # The line of each leg, and its rods, which a gauge touches.",
        "  legs:",
        *(line for k in letters for line in _leg_lines(k, tip, rods, in_mm(machine.rod_radius))),
        f"  tcp: {{frame: tcp, coordinates: [{', '.join(machine.coordinates)}]}}",
        "  # Named sums of elementary errors; '-' subtracts.",
        "  parameters:",
        *(f"    {name}: [{', '.join(members)}]" for name, members in parameters.items()),
        "  # Limits of the errors before the calibration: 19 of 20 errors are within them.",
        f"  tolerances: {{{tolerances}}}",
        "  # Free errors of each model. complete: every error that moves a rod or the tool.",
        "  models:",
        *_model_lines({**MODELS, **(models or {})}),
    ]
    return "\n".join(lines) + "\n"


def _place_lines(workspace: Sequence[Sequence[float]] | None, bed: float | None) -> list[str]:
    """YAML of workspace and bed; see `robot_yaml`."""
    lines = [] if workspace is None else [f"  workspace: {{box_mm: {box_text(workspace)}}}"]
    return lines if bed is None else [*lines, BED_COMMENT, f"  bed: {{z_mm: {in_mm(bed)}}}"]


def _model_lines(models: Mapping[str, Sequence[str]]) -> list[str]:
    """YAML of models and the model full."""
    lines = [f"    {name}: [{', '.join(map(repr, globs))}]" for name, globs in models.items()]
    return [*lines, "    full: complete"]


def _gepetto_lines(letters: str, loops: Sequence[Loop]) -> list[str]:
    """YAML of loops and drives in the keys of the Gepetto extended URDF."""
    return [
        "# Loops and drives, in the keys of the Gepetto extended URDF.",
        "closed_loop:",
        *(f"  - [{', '.join(loop.frames)}]" for loop in loops),
        f"type: [{', '.join(loop.kind for loop in loops)}]",
        f"name_mot: [{', '.join(f'{k}_slide' for k in letters)}]",
        "",
    ]


def _rows(rows: Sequence[str]) -> str:
    """YAML of the constrained rows of a closure; "" for all rows."""
    return f"rows: [{', '.join(rows)}]" if rows else ""


def _leg_lines(k: str, tip: str, rods: Mapping[str, tuple[str, str]], radius: str) -> list[str]:
    """YAML of a leg k.

    Args:
        k: Name of the leg.
        tip: Frame at its end; {k} is the leg.
        rods: Frames at both ends of each rod; {k} is the leg.
        radius: Radius of a rod in mm, as text.
    """
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
