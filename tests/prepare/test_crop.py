"""The paper's crop rule on cases worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest

from splashbench.prepare.crop import PixelBox, bounding_box, crop_window


@pytest.mark.parametrize(
    ("union", "size", "expected"),
    [
        # 4K, nothing near the border: 100 + 2 x 96 = 292 -> 296, 200 + 192 = 392 = 49 x 8.
        (PixelBox(1000, 500, 1100, 700), (3840, 2160), PixelBox(904, 404, 1200, 796)),
        # A single pixel: 193 -> 200 in both directions, added at the right and the bottom.
        (PixelBox(1000, 1000, 1001, 1001), (3840, 2160), PixelBox(904, 904, 1104, 1104)),
        # Cut at the left and top: 0..(50 + 96) = 146 -> 152, 0..(10 + 96) = 106 -> 112.
        (PixelBox(20, 0, 50, 10), (3840, 2160), PixelBox(0, 0, 152, 112)),
        # Cut at the right: 3640..3840 = 200, a multiple already; rows 0..2160 = 270 x 8.
        (PixelBox(3736, 50, 3830, 2100), (3840, 2160), PixelBox(3640, 0, 3840, 2160)),
        # Cut at the right, 203 wide -> 208: the pixels beyond the border are taken at the left.
        (PixelBox(3733, 1000, 3830, 1100), (3840, 2160), PixelBox(3632, 904, 3840, 1200)),
        # Rows 4..266 are 262 -> 264, which 270 rows hold.
        (PixelBox(200, 100, 240, 170), (480, 270), PixelBox(104, 4, 336, 268)),
        # Rows 2..268 are 266 -> 272, which they do not: 264, centred on the padded box.
        (PixelBox(200, 98, 240, 172), (480, 270), PixelBox(104, 3, 336, 267)),
        # As before, but the mask reaches the last row: the window must hold it.
        (PixelBox(200, 100, 240, 270), (480, 270), PixelBox(104, 6, 336, 270)),
        # And the first row.
        (PixelBox(200, 0, 240, 180), (480, 270), PixelBox(104, 0, 336, 264)),
        # A mask of more than 264 of 270 rows leaves no multiple of eight: the whole height.
        (PixelBox(200, 2, 240, 269), (480, 270), PixelBox(104, 0, 336, 270)),
        # The whole image.
        (PixelBox(0, 0, 480, 272), (480, 272), PixelBox(0, 0, 480, 272)),
    ],
)
def test_known_cases(union: PixelBox, size: tuple[int, int], expected: PixelBox) -> None:
    assert crop_window(union, *size) == expected


def test_every_window_obeys_the_rule() -> None:
    rng = np.random.default_rng(0)
    for _ in range(3000):
        width, height = rng.integers(1, 700, 2).tolist()
        x0, x1 = sorted(rng.choice(width + 1, 2, replace=False).tolist())
        y0, y1 = sorted(rng.choice(height + 1, 2, replace=False).tolist())
        window = crop_window(PixelBox(x0, y0, x1, y1), width, height)
        for low, high, start, stop, extent in (
            (x0, x1, window.x0, window.x1, width),
            (y0, y1, window.y0, window.y1, height),
        ):
            assert 0 <= start <= low < high <= stop <= extent
            if high - low <= extent // 8 * 8:
                assert (stop - start) % 8 == 0
            padded = min(high + 96, extent) - max(low - 96, 0)
            # Never larger than needed, and smaller than the padding only where the image has no room.
            assert stop - start < padded + 8
            if -(-padded // 8) * 8 <= extent:
                assert start <= max(low - 96, 0)
                assert stop >= min(high + 96, extent)


def test_bounding_box_is_tight_and_none_when_empty() -> None:
    mask = np.zeros((40, 60), bool)
    assert bounding_box(mask) is None
    mask[5, 7] = mask[30, 50] = True
    box = bounding_box(mask)
    assert box == PixelBox(7, 5, 51, 31)
    assert box.union(None) == box
    assert box.union(PixelBox(0, 10, 8, 40)) == PixelBox(0, 5, 51, 40)
    assert box.cut(mask).shape == (26, 44)
    assert box.cut(mask).sum() == 2
