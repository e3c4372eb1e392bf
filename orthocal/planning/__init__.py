"""Measuring plans: candidate readings, a choice among them, and the expected tool error."""
