"""Reading, interpretation and correction of G-code programs for any machine."""
