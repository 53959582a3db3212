"""Several instruments on one body, compensated together."""
