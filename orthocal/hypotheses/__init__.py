"""Hypotheses about mistakes made while reading, and their evidence in the readings.

The package does not depend on a calibration.
"""
