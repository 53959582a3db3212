"""The exact motion of the output for each form of input."""
