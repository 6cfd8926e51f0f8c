"""The cameras' clocks from their sound."""
