"""What the compiled renderer and its Python side must have in common, and what a rendering says of itself."""

from __future__ import annotations

import ctypes

import numpy as np
import pytest

from splashbench.render import constants, cpu
from splashbench.render.native import KERNEL
from splashbench.scene.camera import Camera


def test_the_kernel_and_python_agree_on_the_numbers():
    values = (ctypes.c_double * 6)()
    KERNEL.library.splash_constants(values)
    names = ("NEAR_PLANE", "BLUR_VARIANCE", "MIN_ALPHA", "MAX_ALPHA", "MIN_TRANSMITTANCE", "JACOBIAN_MARGIN")
    assert list(values) == pytest.approx([getattr(constants, name) for name in names], rel=1e-7)
    assert KERNEL.library.splash_tile_width() == constants.TILE_WIDTH
    assert KERNEL.library.splash_tile_height() == constants.TILE_HEIGHT


def test_a_rendering_says_what_it_drew():
    camera = Camera("1", 128, 64, np.array([[100.0, 0, 64], [0, 100, 32], [0, 0, 1]]), np.eye(4))
    means = np.array([[0, 0, 4.0], [0, 0, -4.0], [-1.2, -0.6, 4.0]], np.float32)
    factors = np.tile(0.1 * np.eye(3, dtype=np.float32), (3, 1, 1))
    rendering = cpu.forward(means, factors, np.ones(3), np.ones((3, 1)), camera)
    # The first lies on the corner of four tiles, the second behind the camera, the third in one tile.
    assert rendering.counts() == {"drawn": 2, "pairs": 5, "tiles": 4}
