"""Specific force from the output of one instrument or of a set, with uncertainty and validity of every row."""
