"""Pictures of the report, embedded so that the page needs nothing else, and its colours."""

from __future__ import annotations

import io
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splashbench.files import jpeg_bytes
from splashbench.pages import data_uri
from splashbench.pages.blocks import Picture

TRAIN_COLOUR, TEST_COLOUR, SWEEP_COLOUR = "#1f5fa8", "#c2571a", "#9a9a9a"


def chart(figure: Any, alt: str) -> Picture:
    """A matplotlib figure as an embedded PNG."""
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=110)
    return Picture(data_uri(stream.getvalue(), "image/png"), alt)


def photograph(image: NDArray[np.uint8], alt: str, caption: str = "") -> Picture:
    """An RGB image uint8 [H, W, 3] as an embedded JPEG."""
    return Picture(data_uri(jpeg_bytes(image, quality=88), "image/jpeg"), alt, caption)
