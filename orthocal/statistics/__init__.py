"""Statistics of arrays: noise, distributions, information and identifiability. Knows no fit."""
