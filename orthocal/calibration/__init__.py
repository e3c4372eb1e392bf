"""A calibration: from a session, as data, as a file, and as a machine that moves."""
