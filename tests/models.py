"""Sets of errors of the Orthoglide that are no models of its own."""

from __future__ import annotations

JOINTS = ("*", "!frame.*", "!*.scale", "!*_leg.length")
"""The 126 placements of its joints and offsets of its drives, idle ones among them."""
