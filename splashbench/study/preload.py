"""What every run imports sooner or later, imported at once: by the process that runs are forked off.

A run that imports it all by itself takes more than a second for that.
"""

from __future__ import annotations

import imageio.plugins.pillow
import imageio.v3
import numba
import PIL.Image
import psutil
import scipy.spatial
import scipy.stats

import splashbench.harness.side_by_side
import splashbench.score.particles.physics
import splashbench.study.job
import splashbench.submission.cameras

__all__ = ["PIL", "imageio", "psutil", "scipy", "splashbench"]


@numba.njit  # type: ignore[untyped-decorator]
def _nothing() -> None:
    return None


_nothing()  # numba loads most of itself with the first function that it compiles
PIL.Image.init()
