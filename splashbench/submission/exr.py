"""Renders as OpenEXR for compositing: linear RGB in half floats, the liquid's opacity in A.

Scoring reads the 8-bit PNGs alone; these files are for people who put the liquid into other pictures.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from splashbench.files import atomic_path
from splashbench.srgb import to_linear


def write_exr(path: Path, rgb: NDArray[np.floating], alpha: NDArray[np.floating]) -> None:
    """Write one frame: rgb [H, W, 3] sRGB in [0, 1], alpha [H, W]. RGB is the whole picture, not premultiplied."""
    pixels = np.concatenate([to_linear(rgb), np.asarray(alpha, dtype=np.float32)[..., None]], axis=-1)
    write_channels(path, {"RGBA": pixels.astype(np.float16)})


def write_channels(path: Path, channels: Mapping[str, NDArray[np.floating]]) -> None:
    """Write an OpenEXR of `channels`: name -> [H, W] or [H, W, C] in the type that is stored, float16 or float32."""
    import OpenEXR

    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with atomic_path(path) as temporary, OpenEXR.File(header, dict(channels)) as file:
        file.write(str(temporary))
