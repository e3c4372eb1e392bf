"""Sensors: a file each, known to all others by its protocol."""
