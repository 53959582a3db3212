"""What the noise does to the covariance of a fit and to its degrees of freedom."""
