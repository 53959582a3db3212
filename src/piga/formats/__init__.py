"""Readers and writers of data files. Each format has one reader, which gives the file in chunks."""
