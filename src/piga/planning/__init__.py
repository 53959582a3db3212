"""Tests to come: positions, length and what they will tell."""
