"""The kinds of test stand."""
