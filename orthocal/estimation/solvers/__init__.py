"""Solvers of a calibration problem, which tests compare with each other."""
