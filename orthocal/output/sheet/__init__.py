"""Measuring sheets to print."""
