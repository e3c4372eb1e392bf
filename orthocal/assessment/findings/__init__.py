"""What was found, what follows from it and what to do next: as data, recognised in one place."""
