"""Solvers of a calibration problem, side by side: each a file, each checks the others."""
