"""Metrics against true particles: geometry and motion (docs/protocol.md, "Against the truth")."""
