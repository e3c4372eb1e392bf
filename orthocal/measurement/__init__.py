"""Session files, import of tables, recording, motion between postures, joined sessions."""
