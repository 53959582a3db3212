"""Figures and pages as data, and what draws them."""
