"""Whole runs: chain of models, budget, ten-day results and their files."""
