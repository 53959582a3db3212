"""The navigator on the platform and how errors grow in it."""
