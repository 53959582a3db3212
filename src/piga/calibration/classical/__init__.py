"""Methods of the literature, kept for comparison."""
