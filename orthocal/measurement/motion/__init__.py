"""Motion of the machine while a session is measured, and G-code programs for it."""
