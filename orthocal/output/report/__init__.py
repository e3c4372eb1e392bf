"""A calibration as one page."""
