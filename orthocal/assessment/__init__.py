"""Assessment of calibrations: tool error, entries, comparison, validation, findings, decision."""
