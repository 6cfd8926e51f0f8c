"""Fetching public files that are not ours to ship: once, verified, and in pieces where the connection breaks."""
