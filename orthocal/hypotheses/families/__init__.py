"""Families of hypotheses about mistakes in a session, one topic per module."""
