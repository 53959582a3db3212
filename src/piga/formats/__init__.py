"""One reader and one writer for each file format; every file is a stream of chunks."""
