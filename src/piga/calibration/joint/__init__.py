"""Several runs of one instrument, estimated together."""
