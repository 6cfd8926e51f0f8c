"""Finding and loading compiled kernels: the right variant, of the right kernel and version, or one clear line."""

from __future__ import annotations

import ctypes
import dataclasses
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from splashbench.errors import SplashbenchError
from splashbench.native.library import CompiledKernel
from splashbench.render.native import KERNEL as RENDERER
from splashbench_methods.splashsplat.kernel.library import KERNEL as SPLASHSPLAT

KERNELS = pytest.mark.parametrize("kernel", [RENDERER, SPLASHSPLAT], ids=lambda kernel: kernel.name)

RENDER = """
import numpy as np
from splashbench.render import native, rasterize_arrays
from splashbench.scene.camera import Camera
rng = np.random.default_rng(0)
camera = Camera("1", 150, 70, np.array([[120.0, 0, 75], [0, 120, 35], [0, 0, 1]]), np.eye(4))
means, factors = rng.normal(size=(900, 3)) + [0, 0, 5], rng.normal(size=(900, 3, 3)) * 0.1
color, opacity = rasterize_arrays(means, factors, rng.random(900), rng.random((900, 3)), camera)
print(native.KERNEL.variant, color.astype(float).sum(), opacity.astype(float).sum())
"""


def render(**environment: str) -> subprocess.CompletedProcess:
    """The variant and two sums of an image, printed by a process of its own."""
    return subprocess.run(
        [sys.executable, "-c", RENDER], capture_output=True, text=True, env={**os.environ, **environment}, timeout=120
    )


@pytest.fixture(autouse=True)
def _nothing_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("SPLASHBENCH_KERNEL", raising=False)
    monkeypatch.delenv("SPLASHBENCH_SIMD", raising=False)


def fresh(kernel: CompiledKernel) -> CompiledKernel:
    """The same kernel, with its library still to be chosen."""
    return dataclasses.replace(kernel)


def runnable(kernel: CompiledKernel) -> list[str]:
    """The built variants that this processor runs."""
    return [variant for variant in kernel.built_variants() if kernel.runs(variant)]


@KERNELS
def test_every_variant_is_built(kernel: CompiledKernel) -> None:
    assert kernel.built_variants() == ["avx2", "avx512", "baseline"]
    assert "baseline" in runnable(kernel)


@KERNELS
def test_the_best_variant_for_this_processor_is_used(kernel: CompiledKernel) -> None:
    assert fresh(kernel).variant == ("avx2" if "avx2" in runnable(kernel) else "baseline")


@KERNELS
def test_a_variant_can_be_asked_for(kernel: CompiledKernel, monkeypatch: pytest.MonkeyPatch) -> None:
    for variant in runnable(kernel):
        monkeypatch.setenv("SPLASHBENCH_SIMD", variant)
        assert fresh(kernel).variant == variant


@KERNELS
def test_a_variant_that_this_processor_does_not_run_is_one_line(
    kernel: CompiledKernel, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(CompiledKernel, "runs", lambda self, variant: variant == "baseline")
    monkeypatch.setenv("SPLASHBENCH_SIMD", "avx2")
    with pytest.raises(SplashbenchError, match=r"_avx2\.so: this processor does not run it; unset SPLASHBENCH_SIMD$"):
        fresh(kernel).library  # noqa: B018


@pytest.mark.parametrize("variant", ["baseline", "avx2", "avx512"])
def test_every_variant_renders_the_same_image(variant: str) -> None:
    if variant not in runnable(RENDERER):
        pytest.skip(f"this processor does not run {variant}")
    outcome = render(SPLASHBENCH_SIMD=variant)
    assert outcome.returncode == 0, outcome.stderr
    name, *sums = outcome.stdout.split()
    assert name == variant
    expected = [float(value) for value in render().stdout.split()[1:]]
    assert [float(value) for value in sums] == pytest.approx(expected, rel=1e-6)


def test_a_variant_that_was_not_built_ends_a_program_in_one_line() -> None:
    outcome = render(SPLASHBENCH_SIMD="avx9")
    assert outcome.returncode == 1
    assert "there is no such kernel (built: avx2, avx512, baseline)" in outcome.stderr.splitlines()[-1]


@KERNELS
def test_a_folder_of_libraries_built_elsewhere(
    kernel: CompiledKernel, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copy2(kernel.folder / f"lib{kernel.name}_baseline.so", tmp_path)
    monkeypatch.setenv("SPLASHBENCH_KERNEL", str(tmp_path))
    assert Path(fresh(kernel).library._name).parent == tmp_path
    assert fresh(kernel).variant == "baseline"  # the best one in there
    monkeypatch.setenv("SPLASHBENCH_SIMD", "avx512")
    with pytest.raises(SplashbenchError, match=rf"{tmp_path}.*there is no such kernel \(built: baseline\)"):
        fresh(kernel).library  # noqa: B018


def test_a_library_built_elsewhere_serves_its_own_kernel_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = Path(shutil.copy2(RENDERER.folder / "librender_baseline.so", tmp_path / "mine.so"))
    monkeypatch.setenv("SPLASHBENCH_KERNEL", str(path))
    assert fresh(RENDERER).library._name == str(path)
    assert Path(fresh(SPLASHSPLAT).library._name).parent == SPLASHSPLAT.folder


@KERNELS
def test_a_file_that_is_no_library_is_refused(
    kernel: CompiledKernel, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for path in (tmp_path / "bad.so", tmp_path / "missing.so"):
        (tmp_path / "bad.so").write_bytes(b"no library")
        monkeypatch.setenv("SPLASHBENCH_KERNEL", str(path))
        with pytest.raises(SplashbenchError, match=rf"{path.name}: cannot load the kernel {kernel.name} \("):
            fresh(kernel).library  # noqa: B018


@KERNELS
def test_a_library_of_another_version_is_refused(kernel: CompiledKernel, monkeypatch: pytest.MonkeyPatch) -> None:
    newer = dataclasses.replace(kernel, abi_version=kernel.abi_version + 1)
    message = f"of version {kernel.abi_version}, this code needs {newer.abi_version}; install splashbench again"
    with pytest.raises(SplashbenchError, match=message):
        newer.library  # noqa: B018
    monkeypatch.setenv("SPLASHBENCH_KERNEL", ctypes.CDLL(None)._name or "libc.so.6")
    with pytest.raises(SplashbenchError, match=f"of version None, this code needs {kernel.abi_version}; install"):
        fresh(kernel).library  # noqa: B018


def test_a_folder_with_another_kernel_under_this_one_s_name_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copy2(SPLASHSPLAT.folder / "libsplashsplat_baseline.so", tmp_path / "librender_baseline.so")
    monkeypatch.setenv("SPLASHBENCH_KERNEL", str(tmp_path))
    with pytest.raises(SplashbenchError, match=r"librender_baseline\.so: holds another kernel than render; install"):
        fresh(RENDERER).library  # noqa: B018
