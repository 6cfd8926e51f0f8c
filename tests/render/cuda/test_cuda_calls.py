"""What the CUDA backend refuses, what it gives to gsplat, and what it says where it is not available."""

from __future__ import annotations

import inspect
import sys
from collections.abc import Callable
from pathlib import Path
from subprocess import run
from types import ModuleType
from typing import Any

import gsplat_stand_in
import numpy as np
import pytest
import torch
from cuda_comparison import SIDE, VIEW, ComparedBackend, random_gaussians

from splashbench.errors import SplashbenchError
from splashbench.render import counters, cuda, freeze, rasterize, tile_grid


def _spoil(name: str, value: Callable[[torch.Tensor], Any]) -> dict[str, Any]:
    arguments = dict(zip(("means", "factors", "opacities", "colors"), random_gaussians(0, 5)))
    arguments |= {"cameras": VIEW, "background": torch.rand(3), "modes": np.ones(tile_grid(140, 90), np.uint8)}
    return arguments | {name: value(arguments[name])}


def _with(entry: float) -> Callable[[torch.Tensor], torch.Tensor]:
    def changed(tensor: torch.Tensor) -> torch.Tensor:
        tensor = tensor.clone()
        tensor.view(len(tensor), -1)[3 if len(tensor) > 3 else 1, 0] = entry
        return tensor

    return changed


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *[(name, _with(bad)) for name in ("means", "factors", "opacities", "colors") for bad in (np.nan, -np.inf)],
        ("means", lambda t: t.double() * 1e200),
        ("means", lambda t: t[:, :2]),
        ("factors", lambda t: t[:4]),
        ("opacities", lambda t: t[:, None]),
        ("colors", lambda t: t.repeat(1, 11)),
        ("means", lambda t: t.long()),
        ("colors", lambda t: t.to(torch.complex64)),
        ("background", _with(np.nan)),
        ("background", lambda t: t[:2]),
        ("background", lambda t: t.long()),
        ("modes", lambda a: a[:2]),
        ("modes", lambda a: a + 2),
        ("cameras", lambda c: c.K),
    ],
)
def test_bad_input_is_refused_as_on_the_cpu(backend: ComparedBackend, name: str, value: Callable[[Any], Any]) -> None:
    arguments = _spoil(name, value)
    with pytest.raises((ValueError, TypeError)) as refused:
        rasterize(**arguments, backend="cpu")
    on_device = {n: v.to(backend.device) if isinstance(v, torch.Tensor) else v for n, v in arguments.items()}
    with pytest.raises(refused.type) as refused_here:
        rasterize(**on_device, backend="cuda")
    assert str(refused_here.value) == str(refused.value)
    assert name in str(refused.value)


def test_colors_for_another_number_of_cameras_are_refused(stand_in: ComparedBackend) -> None:
    gaussians = random_gaussians(0, 5)
    colors = gaussians[3].expand(2, -1, -1)
    with pytest.raises(ValueError, match="colors is for 2 cameras, not 1"):
        cuda.rasterize(*gaussians[:3], colors, [{"camera": VIEW}])


def test_frozen_gaussians_of_another_camera_are_refused(backend: ComparedBackend) -> None:
    gaussians = [t.to(backend.device) for t in random_gaussians(0, 5)]
    with pytest.raises(ValueError, match="frozen was made for another camera"):
        rasterize(*gaussians, SIDE, frozen=freeze(*random_gaussians(1, 5), VIEW), backend="cuda")


def test_what_gsplat_is_given(stand_in: ComparedBackend) -> None:
    gaussians = random_gaussians(13, 20, channels=32)
    rasterize(*gaussians, [VIEW, SIDE], depth=True, background=torch.ones(32, requires_grad=True), backend="cuda")
    (call,) = stand_in.calls
    covariances = gaussians[1].double() @ gaussians[1].double().transpose(1, 2)
    assert torch.equal(call["covars"], call["covars"].transpose(1, 2))
    assert torch.allclose(call["covars"].double(), covariances, rtol=1e-5, atol=1e-7)
    assert (call["quats"], call["scales"]) == (None, None)
    assert torch.equal(call["viewmats"], torch.tensor(np.stack([VIEW.w2c, SIDE.w2c]), dtype=torch.float32))
    assert torch.equal(call["Ks"], torch.tensor(np.stack([VIEW.K, SIDE.K]), dtype=torch.float32))
    assert torch.equal(call["backgrounds"], torch.ones((2, 32)))
    numbers = {name: call[name] for name in ("width", "height", "near_plane", "radius_clip", "eps2d")}
    assert numbers == {"width": 140, "height": 90, "near_plane": 0.01, "radius_clip": 0.0, "eps2d": 0.3}
    assert (call["render_mode"], call["rasterize_mode"], call["camera_model"]) == ("RGB+D", "classic", "pinhole")
    assert call["channel_chunk"] >= 33
    assert call["far_plane"] > 1e30


def test_the_backend_is_counted(stand_in: ComparedBackend) -> None:
    counters.reset()
    rasterize(*random_gaussians(0, 5), VIEW, frozen=freeze(*random_gaussians(1, 7), VIEW), backend="cuda")
    assert (counters.calls(), counters.total()) == (1, 12)
    assert "cuda (gsplat 1.5.3)" in counters.backends()


@pytest.mark.cuda
def test_the_stand_in_has_gsplats_signature(reference: ModuleType, real: ComparedBackend) -> None:
    import gsplat

    ours = inspect.signature(gsplat_stand_in.GsplatStandIn(reference).rasterization).parameters
    theirs = inspect.signature(gsplat.rasterization).parameters
    assert list(ours) == list(theirs)
    different = {name for name in ours if ours[name].default != theirs[name].default}
    assert different == {"rolling_shutter"}  # a value of gsplat's own enumeration there


@pytest.mark.cuda
def test_tensors_on_the_device_are_rendered_there_and_stay_there(real: ComparedBackend) -> None:
    color, opacity = rasterize(*(t.cuda() for t in random_gaussians(0, 20)), VIEW)
    assert (color.is_cuda, opacity.is_cuda) == (True, True)
    color, opacity = rasterize(*random_gaussians(0, 20), VIEW, backend="cuda")
    assert (color.is_cuda, opacity.is_cuda) == (False, False)


def test_importing_it_needs_no_gsplat_and_no_device() -> None:
    code = "import sys; import splashbench.render.cuda; print([m for m in sys.modules if m.startswith('gsplat')])"
    result = run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout == "[]\n"


@pytest.mark.parametrize(
    ("spoil", "reason"),
    [
        (lambda m: m.setattr(torch.cuda, "is_available", lambda: False), "PyTorch sees no CUDA device; use backend="),
        (lambda m: m.setitem(sys.modules, "gsplat", None), r"pip install -c constraints.txt -e '\.\[cuda\]'"),
        (
            lambda m: m.setattr(sys.modules["gsplat"], "__version__", "1.6.0"),
            "version 1.6.0.*; pip install gsplat==1.5.3",
        ),
    ],
)
def test_it_says_why_it_is_not_available(
    stand_in: ComparedBackend, monkeypatch: pytest.MonkeyPatch, spoil: Callable[[pytest.MonkeyPatch], None], reason: str
) -> None:
    spoil(monkeypatch)
    with pytest.raises(SplashbenchError, match=reason) as refused:
        rasterize(*random_gaussians(0, 5), VIEW, backend="cuda")
    assert "\n" not in str(refused.value)
    with pytest.raises(SplashbenchError, match=reason):
        cuda.rasterize(*random_gaussians(0, 5), [{"camera": VIEW}])


def test_kernels_that_cannot_be_compiled(
    stand_in: ComparedBackend, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.delitem(sys.modules, "gsplat.csrc")
    sys.modules["gsplat"].__path__ = []  # a package without the compiled module
    for name in ("PATH", "CUDA_HOME"):
        monkeypatch.setenv(name, str(tmp_path))
    reason = cuda.available()
    assert reason is not None
    assert "install the CUDA toolkit" in reason
    (tmp_path / "bin").mkdir()
    (tmp_path / "bin" / "nvcc").touch()
    cuda.available.cache_clear()
    assert cuda.available() is None


def test_a_local_version_of_gsplat_will_do(stand_in: ComparedBackend, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys.modules["gsplat"], "__version__", "1.5.3+pt24cu124")
    assert cuda.available() is None
