"""Scenes of machines with meshcat: shapes, pages, live server and pictures."""
