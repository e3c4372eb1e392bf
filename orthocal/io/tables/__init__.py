"""Tables as spreadsheets write them: bytes to cells, and what was understood on the way."""
