"""Read text logs: encoding, separators, decimal marks, faults."""
