"""Text logs: encoding, separators, decimal signs, faults."""
