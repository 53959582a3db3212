"""Test stands as simulated machines: each gives specific force and base rate with its own errors."""
