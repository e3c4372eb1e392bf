"""Motion from posture to posture while measuring, and programs for it."""
