"""A session, a calibration or a robot as a scene."""
