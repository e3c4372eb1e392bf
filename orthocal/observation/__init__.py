"""Predicted readings: linearisation, batches, simulation."""
