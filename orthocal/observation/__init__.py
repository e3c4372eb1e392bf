"""Prediction, linearisation and simulation of readings."""
