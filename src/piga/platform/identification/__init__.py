"""What the platform can find out about itself: alignment and misalignment of the cases."""
