"""What others take: a calibration as files for controllers and for other programs."""
