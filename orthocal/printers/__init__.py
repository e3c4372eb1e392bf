"""Firmware of delta printers: kinematics, settings and logs."""
