"""Export of a calibration to controllers and other programs."""
