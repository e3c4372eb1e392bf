"""Reports of studies as text, JSON and figures."""
