"""External codes, run by their own commands in their own environments: Scene -> Submission."""
