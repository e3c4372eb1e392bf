"""Robot files of machines of given kind and dimensions."""
