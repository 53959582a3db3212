"""The page of a test plan."""
