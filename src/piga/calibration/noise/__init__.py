"""Noise of a record, and the weights of its rows."""
