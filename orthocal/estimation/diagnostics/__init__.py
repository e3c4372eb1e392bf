"""Diagnostics of a fit: single readings, cross-validation, intervals, unmodelled errors."""
