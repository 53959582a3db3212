"""What the record's noise is, and how rows are weighted by it."""
