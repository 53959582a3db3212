"""Compiled arithmetic on scalars and float64 arrays; no files, no units, no messages for users."""
