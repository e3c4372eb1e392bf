"""Terminal output: answers, tables and lists as text and JSON."""
