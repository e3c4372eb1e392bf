"""Statistics of readings: noise, distributions, information and identifiability."""
