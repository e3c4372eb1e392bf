"""Calibrate the paper's Experiment 2 in five lines, and check it with Experiment 3."""

from pathlib import Path

import orthocal

TABLE_1 = Path(__file__).parent / "table1"

session = orthocal.load_session(TABLE_1 / "experiment-2")
calibration = orthocal.calibrate(session, "offsets")
print(orthocal.summarize(calibration))

# Where the tool really is when the encoders show the mechanical zero, in mm.
print("Tool at the mechanical zero:", calibration.machine.forward([0.31025] * 3) * 1e3)

# The paper's third experiment: the offsets were entered, and the legs measured again.
afterwards = orthocal.load_session(TABLE_1 / "experiment-3")
print(orthocal.summarize(orthocal.validate_calibration(calibration, afterwards)))
