"""Errors of the Orthoglide: of a simulated machine, and sets that are no models of its own."""

from __future__ import annotations

TRUTH = {"x_slide.offset": 1.2e-3, "y_slide.offset": -0.8e-3, "z_slide.offset": 0.5e-3}
"""Offsets of a simulated machine, [m]."""

JOINTS = ("*", "!frame.*", "!*.scale", "!*_leg.length")
"""The 126 placements of its joints and offsets of its drives, idle ones among them."""
