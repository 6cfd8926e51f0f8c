"""Finding and loading the compiled kernel, and what it must have in common with the Python side."""

from __future__ import annotations

import ctypes
import os
import subprocess
import sys

import numpy as np
import pytest

from splashbench.errors import SplashbenchError
from splashbench.render import constants, cpu, native
from splashbench.scene.camera import Camera

RENDER = """
import numpy as np
from splashbench.render import native, rasterize_arrays
from splashbench.scene.camera import Camera
rng = np.random.default_rng(0)
camera = Camera("1", 150, 70, np.array([[120.0, 0, 75], [0, 120, 35], [0, 0, 1]]), np.eye(4))
means, factors = rng.normal(size=(900, 3)) + [0, 0, 5], rng.normal(size=(900, 3, 3)) * 0.1
color, opacity = rasterize_arrays(means, factors, rng.random(900), rng.random((900, 3)), camera)
print(native.variant(), color.astype(float).sum(), opacity.astype(float).sum())
"""


def run(**environment: str) -> subprocess.CompletedProcess:
    return subprocess.run(
        [sys.executable, "-c", RENDER], capture_output=True, text=True, env={**os.environ, **environment}, timeout=120
    )


def runnable() -> list[str]:
    """The built variants that this processor runs."""
    return [variant for variant in native.built_variants() if native.runs(variant)]


def test_the_best_variant_for_this_processor_is_used():
    if os.environ.get("SPLASHBENCH_KERNEL") or os.environ.get("SPLASHBENCH_SIMD"):
        pytest.skip("the environment asks for another kernel")
    assert native.variant() == ("avx2" if "avx2" in runnable() else native.built_variants()[0])


def test_a_variant_that_this_processor_does_not_run_is_one_line(monkeypatch):
    others = [variant for variant in native.built_variants() if variant not in runnable()]
    if not others:
        pytest.skip("this processor runs every variant that was built")
    monkeypatch.delenv("SPLASHBENCH_KERNEL", raising=False)
    done = run(SPLASHBENCH_SIMD=others[0])
    assert done.returncode == 1
    assert "this processor does not run it" in done.stderr.splitlines()[-1]


@pytest.mark.parametrize("variant", ["baseline", "avx2", "avx512", "neon"])
def test_every_variant_renders_the_same_image(variant, monkeypatch):
    if variant not in runnable():
        pytest.skip(f"no {variant} kernel that runs on this processor")
    monkeypatch.delenv("SPLASHBENCH_KERNEL", raising=False)
    done = run(SPLASHBENCH_SIMD=variant)
    assert done.returncode == 0, done.stderr
    name, color, opacity = done.stdout.split()
    assert name == variant
    expected = [float(value) for value in run().stdout.split()[1:]]
    assert [float(color), float(opacity)] == pytest.approx(expected, rel=1e-6)


def test_a_variant_that_was_not_built_is_one_line(monkeypatch):
    monkeypatch.delenv("SPLASHBENCH_KERNEL", raising=False)
    done = run(SPLASHBENCH_SIMD="avx9")
    assert done.returncode == 1
    assert "there is no such kernel of the renderer (built: " in done.stderr.splitlines()[-1]


def test_a_library_that_is_none_or_of_another_version_is_refused(tmp_path, monkeypatch):
    bad = tmp_path / "libsplash_bad.so"
    bad.write_bytes(b"no library")
    monkeypatch.setenv("SPLASHBENCH_KERNEL", str(bad))
    native.library.cache_clear()
    try:
        with pytest.raises(SplashbenchError, match=r"libsplash_bad.so: cannot load the renderer's kernel"):
            native.library()
        monkeypatch.setenv("SPLASHBENCH_KERNEL", ctypes.CDLL(None)._name or "libc.so.6")
        with pytest.raises(
            SplashbenchError,
            match=rf"is of version None, this code needs {native.ABI_VERSION}; install splashbench again",
        ):
            native.library()
    finally:
        native.library.cache_clear()


def test_the_kernel_and_python_agree_on_the_numbers():
    values = (ctypes.c_double * 6)()
    native.library().splash_constants(values)
    names = ("NEAR_PLANE", "BLUR_VARIANCE", "MIN_ALPHA", "MAX_ALPHA", "MIN_TRANSMITTANCE", "JACOBIAN_MARGIN")
    assert list(values) == pytest.approx([getattr(constants, name) for name in names], rel=1e-7)
    assert native.library().splash_tile_width() == constants.TILE_WIDTH
    assert native.library().splash_tile_height() == constants.TILE_HEIGHT


def test_a_rendering_says_what_it_drew():
    camera = Camera("1", 128, 64, np.array([[100.0, 0, 64], [0, 100, 32], [0, 0, 1]]), np.eye(4))
    means = np.array([[0, 0, 4.0], [0, 0, -4.0], [-1.2, -0.6, 4.0]], np.float32)
    factors = np.tile(0.1 * np.eye(3, dtype=np.float32), (3, 1, 1))
    rendering = cpu.forward(means, factors, np.ones(3), np.ones((3, 1)), camera)
    # The first lies on the corner of four tiles, the second behind the camera, the third in one tile.
    assert rendering.counts() == {"drawn": 2, "pairs": 5, "tiles": 4}
