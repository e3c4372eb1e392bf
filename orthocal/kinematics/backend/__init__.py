"""Evaluation of CasADi functions at many points."""
