"""Kinds of mistake, one family a file: which edits of the readings would mend it."""
