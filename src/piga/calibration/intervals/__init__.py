"""Effect of the noise on the covariance of a fit and on its degrees of freedom."""
