"""What to enter into the controller, as a table and what is to be known of it."""

from __future__ import annotations

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from orthocal.assessment.controller_entries import ControllerEntry, find_entries
from orthocal.assessment.findings.calibration import decide
from orthocal.calibration.calibration import Calibration
from orthocal.output.text.explanation import advise
from orthocal.output.text.layout import add_row, plain, signed, table_of


def render_controller(calibration: Calibration) -> RenderableType:
    """What to enter into the controller, and all that is to be known of it."""
    if not find_entries(calibration):
        return Text("Nothing: no offset was identified.")
    return Group(Text(advise(calibration)), entry_table(calibration), *render_meaning(calibration))


def entry_table(calibration: Calibration) -> Table:
    """What to enter, drive by drive, and where the sliders really are."""
    identified = None if calibration.only_offsets else "identified"
    return _table(calibration, enter="enter", spread="± σ", identified=identified)


def short_entry_table(calibration: Calibration) -> Table:
    """What to enter, or to leave, with the ± of all that is not known."""
    leave = decide(calibration).answer == "nothing to enter"
    return _table(calibration, enter="found" if leave else "enter", spread="±", identified=None)


def _table(calibration: Calibration, *, enter: str, spread: str, identified: str | None) -> Table:
    entries = find_entries(calibration)
    stated = any(e.active is not None for e in entries)
    add = "add to the present offset" if enter == "enter" else f"{enter} beside the present offset"
    columns = [*(["active now", enter] if stated else [add]), spread]
    table = table_of("drive", *columns, *([identified] if identified else []), "unit")
    for e in entries:
        factor = e.edge_factor
        now = [] if e.active is None else [signed(e.active * factor)]
        own = [signed(e.identified * factor)] if identified else []
        known = e.held or plain(e.std * factor)
        add_row(table, e.drive, *now, signed(e.enter * factor), known, *own, e.edge_unit)
    return table


def render_meaning(calibration: Calibration) -> list[RenderableType]:
    """What an offset is, and what these are for."""
    decision = decide(calibration)
    notes = [_example(calibration, find_entries(calibration)[0])]
    notes += [found.text for found in decision.of_kind("controller not stated")]
    if not calibration.only_offsets:
        notes.append(
            "For a controller that takes offsets and nothing else: these leave the least error "
            "at the tool of work that is aligned on the machine (shift and rotation taken "
            "out), making up for a part of the other errors; ± says how well that is known. "
            "The identified ones are where the sliders really are: for what knows all errors "
            "(`orthocal inverse`)."
        )
        notes += [found.text for found in decision.of_kind("at the tool")]
    return [Text(note) for note in notes]


def _example(calibration: Calibration, entry: ControllerEntry) -> str:
    """What an offset is, by the first drive at its mechanical zero."""
    drive = next(d for d in calibration.robot.drives if d.name == entry.drive)
    factor, unit = drive.edge_factor, drive.edge_unit
    whole = "the whole offset, in place of the active one" if entry.active is not None else "more"
    at, really = drive.zero * factor, (drive.zero + entry.identified) * factor
    if entry.active is None:
        return (
            "An offset is what to add to the encoder's coordinate to get the slider's true one; "
            f"these are what to add {whole}."
        )
    shown = ""
    if drive.direction < 0 or drive.joint_zero is not None:
        joint = float(drive.to_joint(drive.zero)) * factor
        shown = f" (the controller's joint shows {joint:.3f} {unit})"
    return (
        f"An offset is what to add to the encoder's coordinate to get the slider's true one: with "
        f"{drive.name}'s encoder at {at:.3f} {unit}{shown} its slider is at {really:.3f} {unit}. "
        f"Enter {whole}."
    )
