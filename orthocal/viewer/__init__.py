"""The machine to look at: scenes for meshcat, live, as a page and as a picture."""
