"""Somebody else's code, run by its own commands in its own environment: Scene -> Submission."""
