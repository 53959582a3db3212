"""What is asked of a record, as linear equations and their solution."""
