"""Scenes of robots, sessions and calibrations."""
