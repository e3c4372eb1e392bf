"""Files and documents: bounded reading, atomic writing, YAML, JSON, CSV, tables."""
