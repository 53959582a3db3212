"""ISO/IEC 17025 certificates and digital calibration certificates (DCC)."""
