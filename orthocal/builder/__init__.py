"""Robot files of an Orthoglide with given dimensions."""
