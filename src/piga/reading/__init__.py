"""How raw columns of a file become a checked run."""
