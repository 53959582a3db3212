"""The platform and its motion: geometry, drift of the gyros, case rotation."""
