"""Worker processes, interrupts, standard streams and the disk cache."""
