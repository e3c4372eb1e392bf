"""Import of readings from spreadsheets and tables."""
