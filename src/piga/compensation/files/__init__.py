"""Compensation from file to file and of live streams."""
