"""Studies as text, plain data and pictures: a file a kind."""
