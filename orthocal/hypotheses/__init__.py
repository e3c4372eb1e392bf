"""Mistakes made while reading, as hypotheses: which of them do the readings speak for?

It knows no calibration.
"""
