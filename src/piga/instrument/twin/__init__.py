"""The servo-loop twin: rigid body, electronics and what theory predicts of it."""
