"""What if: many machines, many readings, run by as many workers as there are."""
