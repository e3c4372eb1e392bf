"""Changes of a machine between sessions."""
