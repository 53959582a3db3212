"""Type B sources, the budget table and Monte Carlo."""
