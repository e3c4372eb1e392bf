"""The report of a calibration, and the figures of all reports."""
