"""Replay: a submission's fitted model opened again, to be looked at from anywhere at any time."""

from splashbench.replay.reconstruction import Reconstruction, load

__all__ = ["Reconstruction", "load"]
