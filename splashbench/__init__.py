"""splashbench: reconstruct splashing liquids from several cameras, and score reconstructions by one fixed protocol.

The stages, one noun each: Session -> Scene -> Submission -> Result -> Leaderboard (see docs/ and README.md).
Nothing heavy is imported here, so that `splashbench --help` answers at once.
"""

from splashbench.version import __version__

__all__ = ["__version__"]
