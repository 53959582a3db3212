"""The pages of a compensated record, of one instrument or of a set."""
