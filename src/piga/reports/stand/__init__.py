"""The page of a simulated test."""
