"""Parameters with their units as YAML, for other programs; `simulate --errors` reads it, too."""

from __future__ import annotations

import yaml

from orthocal.assessment.controller_entries import find_entries
from orthocal.calibration.calibration import Calibration
from orthocal.units import tidy

HEAD = """\
# Errors of the machine as identified: what it has beyond the nominal robot.
# `enter` is what belongs into a controller that takes nothing but offsets of its drives.
"""


def export_parameters(calibration: Calibration) -> dict[str, str]:
    """errors.yaml: every parameter under its name with its unit, and offsets to enter."""
    errors = {
        f"{p.name}_{p.edge_unit}": tidy(p.value * p.edge_factor) for p in calibration.parameters
    }
    enter = {
        f"{e.drive}_{e.edge_unit}": tidy(e.enter * e.edge_factor) for e in find_entries(calibration)
    }
    document = {"errors": errors}
    text = yaml.safe_dump(document, sort_keys=False, default_flow_style=False)
    lines = [f"#   {name}: {value}" for name, value in enter.items()]
    listed = "# enter:\n" + "\n".join(lines) + "\n" if lines else ""
    return {"errors.yaml": f"{HEAD}{listed}{text}"}
