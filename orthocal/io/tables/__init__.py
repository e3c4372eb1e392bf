"""Tables of spreadsheet programs: cells of delimited text and of workbooks."""
