"""One file for each kind of test stand."""
