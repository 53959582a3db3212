"""The navigator on the platform, and the growth of its errors."""
