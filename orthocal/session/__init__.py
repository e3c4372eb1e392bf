"""Data of a session: setups, postures, readings, gauges."""
