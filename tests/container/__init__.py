"""A package, so that its modules share what painted.py makes."""
