"""The digital calibration certificate: written, read, signed and verified."""
