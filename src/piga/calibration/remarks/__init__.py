"""Doubts about model and data, and what to do about each."""
