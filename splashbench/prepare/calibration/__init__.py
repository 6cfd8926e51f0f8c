"""The cameras' lenses, from prints of known size."""
