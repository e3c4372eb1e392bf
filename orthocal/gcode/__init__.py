"""G-code as text that is rewritten: knows no machine but a function of points."""
