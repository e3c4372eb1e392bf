"""Text, JSON, reports, sheets and scenes."""
