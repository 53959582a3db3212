"""The servo-loop twin: rigid body, electronics and theoretical predictions."""
