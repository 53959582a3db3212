"""From a run and a calibration record to specific force and velocity increments."""
