"""sRGB (IEC 61966-2-1): its transfer curve, both ways, and its colours as they are written."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def to_linear(values: NDArray[np.floating]) -> NDArray[np.float32]:
    """Linear light of sRGB values, clipped to [0, 1]."""
    values = np.clip(np.asarray(values, dtype=np.float32), 0.0, 1.0)
    return np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4).astype(np.float32)


def to_srgb(linear: NDArray[np.floating]) -> NDArray[np.float32]:
    """sRGB values of linear light, clipped to [0, 1]."""
    light = np.clip(np.asarray(linear, dtype=np.float32), 0.0, 1.0)
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055).astype(np.float32)


def hex_color(srgb: NDArray[np.floating]) -> str:
    """`srgb` [3] in [0, 1], clipped, as viewers and web pages take it, such as #a69583."""
    return "#" + "".join(f"{value:02x}" for value in np.rint(np.clip(srgb, 0, 1) * 255.0).astype(int).tolist())
