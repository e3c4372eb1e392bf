"""Wording of findings: one module per group, no logic."""
