"""Reading, interpreting and correcting G-code programs, for any machine."""
