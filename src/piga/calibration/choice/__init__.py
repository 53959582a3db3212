"""Comparison of sets of terms."""
