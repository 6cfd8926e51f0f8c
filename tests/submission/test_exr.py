"""OpenEXR output: linear light and the liquid's opacity."""

from pathlib import Path

import numpy as np
import pytest

from splashbench.srgb import to_linear
from splashbench.submission.exr import write_exr


def test_the_transfer_curve_has_its_known_values() -> None:
    np.testing.assert_allclose(to_linear(np.array([0.0, 0.04045, 0.5, 1.0])), [0, 0.0031308, 0.2140411, 1], atol=1e-6)


def test_an_exr_reads_back(tmp_path: Path) -> None:
    OpenEXR = pytest.importorskip("OpenEXR")
    rng = np.random.default_rng(0)
    rgb, alpha = rng.random((6, 9, 3)), rng.random((6, 9))
    write_exr(tmp_path / "frames" / "000000.exr", rgb, alpha)
    with OpenEXR.File(str(tmp_path / "frames" / "000000.exr")) as file:
        pixels = file.channels()["RGBA"].pixels
    np.testing.assert_allclose(pixels[..., :3], to_linear(rgb), atol=1e-3)
    np.testing.assert_allclose(pixels[..., 3], alpha, atol=1e-3)
