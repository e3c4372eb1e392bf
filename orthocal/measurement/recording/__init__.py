"""Recording of readings at the machine, one at a time."""
