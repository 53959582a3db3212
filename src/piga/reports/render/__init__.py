"""Figures and pages as data, and their renderers."""
