"""Particle metrics: density, uniformity, energy (docs/protocol.md)."""
