"""Readers of results: figures as data, tables, self-contained pages."""
