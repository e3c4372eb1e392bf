"""Points of a program that are corrected a second, beside the machine itself asked for each."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
from ratios import ratio_of, seconds_of

from orthocal.export.correction_field import CorrectionField
from orthocal.gcode.interpreter import Interpreter
from orthocal.gcode.program import ProgramCorrector
from orthocal.kinematics.backend import llvm

CORRECTED = 9.0
"""Points that are read, corrected and written a second over those that the machine itself corrects
in blocks of a thousand, by CasADi's machine. 19 to 28 were measured on a busy machine; a program
asks for four or five points a piece."""

LINES = 8000


def test_programs_are_corrected_faster_than_the_machine_is_asked(
    orthoglide, record_property, monkeypatch
):
    errors = {"x_slide.offset": 1e-3, "y_slide.offset": -1e-3, "z_slide.offset": 2e-3}
    machine = SimpleNamespace(robot=orthoglide, errors=errors, displacement=np.zeros_like)
    field = CorrectionField(machine, np.zeros(3), within=1e-6)
    t = np.linspace(0.0, 60.0, LINES)
    points = np.stack([40.0 * np.cos(t), 40.0 * np.sin(t), 10.0 * np.sin(0.1 * t)], axis=1)
    text = ["G21 G0 X0 Y0 Z0\n", "F100\n"]
    text += [f"G1 X{x:.4f} Y{y:.4f} Z{z:.4f}\n" for x, y, z in points]

    def correct():
        interpreter = Interpreter(axes=field.axes, offsets={})
        corrector = ProgramCorrector(interpreter, field, file="p.ngc", within=1e-6)
        return sum(1 for _ in corrector.run(text))

    def ask():
        with monkeypatch.context() as patch:
            patch.setattr(llvm, "is_installed", lambda: False)
            field.exactly(points[:1000] * 1e-3)

    correct()  # polynomials, and functions that are compiled
    ask()
    ratio = ratio_of(
        lambda: seconds_of(ask) / 1000, lambda: seconds_of(correct) / LINES, above=CORRECTED
    )
    record_property("points a second over those of the machine", ratio)
    assert ratio > CORRECTED
