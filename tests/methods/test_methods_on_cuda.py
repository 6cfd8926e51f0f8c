"""The methods that take a CUDA device, on one: fits, renders, what is saved, and the losses."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from splashbench.gaussians.color_loss import l1
from splashbench.gaussians.ssim import SsimTarget, ssim
from splashbench.harness.contract import Fitted, Method, Run
from splashbench.harness.discovery import load_method, registered
from splashbench.harness.runner import run_method
from splashbench.render import cuda
from splashbench.scene import Scene
from splashbench.score import score_submission

pytestmark = pytest.mark.cuda

#: Small fits that grow, prune, split and, where a method has it, sample by its guide.
SMALL: dict[str, dict[str, Any]] = {
    "splashsplat": {"hull_cells": 48, "transport_cells": 24, "control_cells": 8, "iterations": 200},
    "spacetime_gaussians": {"iterations": 200, "static_points": 300, "hull_points": 400, "max_gaussians": 1500},
    "spacetime_gaussians_lite": {"iterations": 200, "static_points": 300, "hull_points": 400, "max_gaussians": 1500},
    "deformable_3dgs": {"iterations": 200, "static_points": 300, "hull_points": 400, "max_gaussians": 1500},
    "scaffold_4d": {"iterations": 200, "static_points": 300, "hull_points": 400, "max_anchors": 1500},
    "scaffold_gs": {"iterations": 200, "max_anchors": 800},
}


@pytest.fixture(autouse=True)
def _device() -> None:
    reason = cuda.available()
    if reason is not None:
        pytest.skip(reason)


def test_all_methods_that_take_cuda_are_tested() -> None:
    assert {name for name in registered() if "cuda" in getattr(load_method(name), "devices", ())} == SMALL.keys()


def _fit(name: str, scene: Scene, device: str) -> tuple[Method, Fitted]:
    method = load_method(name)
    return method, method.fit(scene.training(), method.Config.preset("quick", SMALL[name]), Run(device=device))


def _psnr(fitted: Fitted, scene: Scene) -> float:
    errors = []
    for name in scene.train:
        for t in range(0, scene.n_frames, 3):
            rgb = fitted.render(scene.cameras[name], float(scene.times[t])).rgb
            errors.append(np.square(rgb - scene.image(name, t) / 255).mean())
    return float(-10 * np.log10(np.mean(errors)))


@pytest.mark.parametrize("name", SMALL)
def test_a_fit_is_as_good_as_the_cpus(name: str, balls: Scene, tmp_path: Path) -> None:
    (method, on_device), (_, on_cpu) = (_fit(name, balls, device) for device in ("cuda", "cpu"))
    assert _psnr(on_device, balls) == pytest.approx(_psnr(on_cpu, balls), abs=1.0)
    on_device.save(tmp_path)
    loaded = method.load(tmp_path, balls.training())
    camera, time = balls.cameras["6"], float(balls.times[3])
    expected = loaded.render(camera, time)
    loaded.to_device("cuda")
    render = loaded.render(camera, time)
    for theirs, ours in ((expected.rgb, render.rgb), (expected.alpha, render.alpha)):
        difference = np.abs(theirs - ours)
        assert np.quantile(difference, 0.99) < 1e-3, difference.max()


def test_a_run_names_device_and_renderer(balls_directory: Path, tmp_path: Path) -> None:
    settings = SMALL["spacetime_gaussians"]
    submission = run_method(
        "spacetime_gaussians", balls_directory, tmp_path / "run", overrides=settings, device="auto", timing_frames=4
    )
    assert submission.record.status == "ok", submission.record.reason
    assert submission.identity.device == "cuda"
    assert submission.identity.hardware["gpu"] == torch.cuda.get_device_name()
    assert submission.record.peak_device_memory_bytes > 0
    assert any("gsplat" in name for name in submission.record.renderer)
    assert score_submission(Scene.open(balls_directory), submission).status == "ok"


def test_the_losses_are_the_cpus() -> None:
    rng = np.random.default_rng(0)
    photograph = rng.integers(0, 256, (160, 240, 3)).astype(np.uint8)
    seen = rng.random((160, 240)) < 0.7
    # Smooth as photographs are: there TF32 would cost SSIM two digits.
    smooth = np.linspace(0, 1, 160 * 240 * 3, dtype=np.float32).reshape(160, 240, 3)
    image = torch.from_numpy(smooth).requires_grad_()
    for loss in (
        lambda x: l1(x, photograph, seen),
        lambda x: ssim(x, SsimTarget(smooth[::-1].copy(), seen.astype(np.float32))),
    ):
        expected, value = loss(image), loss(image.cuda())
        assert float(value.detach()) == pytest.approx(float(expected.detach()), abs=1e-5)
        (theirs,), (ours,) = torch.autograd.grad(expected, image), torch.autograd.grad(value, image)
        assert float((theirs - ours).norm() / theirs.norm()) < 1e-3
