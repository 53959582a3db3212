"""JSON schemas of the records, one file per kind and version."""
