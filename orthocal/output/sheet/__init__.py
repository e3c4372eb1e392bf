"""Measuring sheets: paper to measure by."""
