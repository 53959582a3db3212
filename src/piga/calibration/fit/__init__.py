"""Bad samples, the estimate and the residuals of one run."""
