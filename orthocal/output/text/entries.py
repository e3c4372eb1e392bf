"""Values to enter into the controller, as a table with notes."""

from __future__ import annotations

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from orthocal.assessment.assess import assessment_of, expanded_uncertainty
from orthocal.calibration.assessment_record import ControllerEntry
from orthocal.calibration.calibration import Calibration
from orthocal.output.text.layout import EXPANDED, add_row, plain, signed, table_of


def render_values(calibration: Calibration) -> RenderableType:
    """Meaning of the values to enter, and those that the short answer does not list."""
    assessment = assessment_of(calibration)
    if not assessment.entries:
        return Group(Text("None: no offset was identified."), Text(EXPANDED))
    complete = assessment.decision.verdict != "reject" and calibration.only_offsets
    table = _entry_table(calibration, identified=not calibration.only_offsets)
    notes = [_example(calibration, assessment.entries[0])]
    notes += [f.text for f in assessment.of_kind("controller not stated")]
    notes.append(EXPANDED)
    if not calibration.only_offsets:
        notes.append(
            "The values to enter minimise the tool error in a controller that corrects nothing "
            "else: they compensate a part of the other errors. The identified offsets belong to a "
            "controller that corrects all errors (`orthocal inverse`)."
        )
    return Group(*([] if complete else [table]), *map(Text, notes))


def short_entry_table(calibration: Calibration) -> Table:
    """Values to enter, drive by drive."""
    return _entry_table(calibration, identified=False)


def _entry_table(calibration: Calibration, *, identified: bool) -> Table:
    assessment = assessment_of(calibration)
    enter = "estimate" if assessment.of_kind("no change needed") else "enter"
    stated = any(e.active is not None for e in assessment.entries)
    columns = ["now", enter] if stated else ["add" if enter == "enter" else enter]
    table = table_of("drive", *columns, "±", *(["identified"] if identified else []), "unit")
    for e in assessment.entries:
        factor = e.edge_factor
        now = [] if e.active is None else [signed(e.active * factor)]
        estimate = [signed(e.identified * factor)] if identified else []
        half = e.held or plain(expanded_uncertainty(calibration, e) * factor)
        add_row(table, e.drive, *now, signed(e.enter * factor), half, *estimate, e.edge_unit)
    return table


def _example(calibration: Calibration, entry: ControllerEntry) -> str:
    """Meaning of an offset, by the first drive at its mechanical zero."""
    drive = next(d for d in calibration.robot.drives if d.name == entry.drive)
    factor, unit = drive.edge_factor, drive.edge_unit
    meaning = "Slider coordinate = encoder coordinate + offset"
    if entry.active is None:
        return f"{meaning}. Add these values to the present offsets."
    at, actual = drive.zero * factor, (drive.zero + entry.identified) * factor
    shown = ""
    if drive.direction < 0 or drive.joint_zero is not None:
        joint = float(drive.to_joint(drive.zero)) * factor
        shown = f" (the controller's joint shows {joint:.3f} {unit})"
    return (
        f"{meaning}. With {drive.name}'s encoder at {at:.3f} {unit}{shown}, its slider is at "
        f"{actual:.3f} {unit}. Enter the complete offset in place of the present one."
    )
