"""Families of hypotheses, one topic per module: what may have gone wrong with a session."""
