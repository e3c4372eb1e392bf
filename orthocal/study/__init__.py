"""Studies of many simulated machines or resampled readings, run in parallel."""
