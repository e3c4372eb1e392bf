"""Session files: session.yaml, readings.csv, plans; read, checked and written."""
