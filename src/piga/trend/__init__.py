"""Years of one instrument: drift, forecast and control chart."""
