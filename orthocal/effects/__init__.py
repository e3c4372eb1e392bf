"""Systematic effects on a machine: their parameters with priors, and how they act."""
