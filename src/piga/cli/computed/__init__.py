"""Commands that need no recorded test: plan, simulate, run campaigns, analyse the platform, reproduce the literature."""
