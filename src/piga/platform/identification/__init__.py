"""Self-calibration of the platform: alignment, and identification of the misalignment of the cases."""
