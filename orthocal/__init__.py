"""orthocal: calibration of Orthoglide-type parallel robots from dial-indicator readings."""

__version__ = "0.1.0"
