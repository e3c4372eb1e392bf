"""Calibration of a session, its record and file, and the calibrated machine."""
