"""Identification from readings: linearised and exact estimates, results, uncertainty."""
