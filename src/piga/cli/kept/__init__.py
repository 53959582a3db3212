"""Commands for finished calibrations: keep them as evidence, follow them over the years, certify them."""
