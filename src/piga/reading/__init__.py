"""Convert the raw columns of a file to a checked run."""
