"""What follows from the readings: linearised and exact identification, results, uncertainty."""
