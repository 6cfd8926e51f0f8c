"""The first session.toml, by looking at the recordings."""
