"""What to type and to build at a LinuxCNC machine, what it achieves and where it ends: a page."""

from __future__ import annotations

import math
from collections.abc import Sequence

from orthocal.assessment.controller_entries import entered_offsets, find_entries
from orthocal.calibration.calibration import Calibration
from orthocal.export.linuxcnc.approximation import BEYOND, LEVER, Approximation
from orthocal.export.linuxcnc.home_offsets import JointHome
from orthocal.export.linuxcnc.nominal_form import Tangent
from orthocal.export.linuxcnc.words import LETTERS, as_millimetres, plain, rounded_up
from orthocal.units import DRIVE_UNITS, MM, UM

UNITS = (
    "All numbers are in mm and degrees. A machine whose INI says `LINEAR_UNITS = inch` takes "
    "lengths divided by 25.4."
)

FINEST = 1e-9
"""No page promises more, [m]."""


def write_home_page(calibration: Calibration, homes: Sequence[JointHome]) -> str:
    """What to type where offsets alone are entered."""
    std = {e.drive: e.std for e in find_entries(calibration)}
    rows = []
    for i, home in enumerate(homes):
        change = home.show(home.change, sign=True)
        if home.old is None or home.new is None:
            entered = f"what it is now {change}"
        else:
            entered = f"{home.show(home.old)} → **{home.show(home.new)}**"
        known = std.get(home.drive, math.nan)
        doubt = "" if math.isnan(known) else f"± {home.show(known)}"
        way = "up" if home.direction > 0 else "down"
        cells = (
            f"JOINT_{i}",
            plain(home.drive),
            way,
            entered,
            change,
            doubt,
            home.joint_unit,
        )
        rows.append(f"| {' | '.join(cells)} |")
    table = "\n".join(rows)
    unit = homes[0].joint_unit
    size = DRIVE_UNITS[homes[0].unit][1]
    active = ", ".join(f"{v / size:.6g}" for v in entered_offsets(calibration))
    what = "Only offsets of the drives were identified."
    if not calibration.only_offsets:
        what = (
            "More than offsets was identified; these are the ones that leave the least error at\n"
            "the tool while nothing else is corrected."
        )
    return f"""\
# {_title(calibration)}: HOME_OFFSET for LinuxCNC

{what} They belong into HOME_OFFSET; the kinematics stay as
they are.

| section | drive | counts | HOME_OFFSET | change | one σ | unit |
|---|---|---|---|---|---|---|
{table}

1. Copy your INI, so that you can go back.
2. In each section of the table type HOME_OFFSET as it stands there. Add the same change to
   MIN_LIMIT and MAX_LIMIT: they belong to places of the slide, and move along. `joints.ini` beside
   this page has the lines. HOME stays as it is.
3. Start LinuxCNC again and home every joint: until then nothing has changed.
4. Look before you move: with a slide where it was, its joint shows more by the change above.
5. Measure again and run `orthocal validate`. Once typed, the offsets are active: the next
   session.yaml says so (`controller: {{offsets_{unit}: [{active}]}}`).

Home slowly: what a joint moves in one servo period at HOME_LATCH_VEL is how well homing repeats.

{UNITS}
"""


def write_module_page(
    calibration: Calibration, found: Approximation, homes: Sequence[JointHome]
) -> str:
    """How to build the module, what to enter, what it achieves and where it ends."""
    n = len(homes)
    carried = [letter for k, letter in enumerate(LETTERS) if k not in found.coordinates]
    form = f"a polynomial of degree {found.inverse.degree}"
    if isinstance(found.inverse.nominal, Tangent):
        what = f"The inverse kinematics are {form}"
    else:
        what = f"The nominal machine in closed form, and {form} that corrects its drives"
    before = beyond = ""
    if found.nominal is not None:
        before = f" With nominal kinematics it is up to {found.nominal / MM:.3f} mm off."
    if found.beyond is not None:
        left = rounded_up(found.beyond / UM)
        beyond = f" {BEYOND / MM:g} mm beyond a face the tool is off by up to {left} µm."
    achieved = rounded_up(max(found.achieved, FINEST) / UM)
    longer = rounded_up(found.longer / UM)
    reason = "More than offsets was identified"
    if calibration.only_offsets:
        reason = "Offsets alone were identified, and a module was asked for"
    known = [f"JOINT_{i} {h.show(h.old)}" for i, h in enumerate(homes) if h.old is not None]
    kept = f" ({', '.join(known)})" if known else ""
    return f"""\
# {_title(calibration)}: kinematics for LinuxCNC

{reason}: a kinematics module moves the machine as it was calibrated.
{what} ({len(found.inverse.exponents)} terms a joint).

**It keeps the tool within {achieved} µm** of where the calibrated machine has it,
over {found.region} mm, for a tip at {as_millimetres(found.tool)} mm
in the frame of the tool centre point: the largest of {found.checked} points that were not fitted,
and a tenth more.{before} How well the calibration itself is known, its report tells.

## Build and enter

1. `sudo apt install linuxcnc-uspace-dev`, if `halcompile` is not there.
2. Here: `sudo halcompile --install orthocal_kins.c`. The three C files belong together.
3. Copy your INI, so that you can go back. Then type the lines of `kinematics.ini` beside this page.
4. **HOME_OFFSET stays as it was while measuring**{kept}: the module holds the offsets itself.
   Entered beside it they would count twice. Soft limits of joints stay as well.
5. Start LinuxCNC and home every joint.

Readings for orthocal are taken with nominal kinematics: to measure again, type the old lines back.

The drives are joints 0 to {n - 1}: {", ".join(plain(h.drive) for h in homes)}. Joints after
them carry {", ".join(carried)} as they are.

## Where it ends

- **Region.** Beyond {found.region} mm the correction stays what it is on the nearest
  face.{beyond} A larger region: `--half-side-mm`.
- **Tool.** The platform is tilted. A tip {LEVER / MM:g} mm farther, in whichever direction, is off
  by up to {longer} µm: for another tool export again with `--tool`. Tool offsets
  (G43) and work offsets go as ever: what they add is added before.
- **Units.** The module counts in mm and degrees: `LINEAR_UNITS = mm`, `ANGULAR_UNITS = degree`.
- Where a leg does not reach, the module says no, and LinuxCNC stops.
- Forward kinematics iterate on the same numbers, to better than a nanometre.

`orthocal_core.c` needs no LinuxCNC: any controller that takes C99 can call it.
"""


def _title(calibration: Calibration) -> str:
    return plain(calibration.robot.name)
