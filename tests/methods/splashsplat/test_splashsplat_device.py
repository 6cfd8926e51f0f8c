"""splashsplat on a device: what it is given to work with lies there, and what it learns is what the CPU learns."""

from __future__ import annotations

import copy
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

sys.path.insert(0, str(Path(__file__).parents[2]))  # for the module in tests/
from virtual_device import DEVICE, VirtualTensor, virtual_device

from splashbench.gaussians.torch_threads import one_torch_thread
from splashbench.harness import side_by_side
from splashbench.harness.checkpoints import Checkpoints
from splashbench.harness.contract import Fitted, Run
from splashbench.render import autograd, backends
from splashbench.scene import Scene
from splashbench_methods.scaffold_gs.model import AnchorModel, StaticAnchorSpec
from splashbench_methods.splashsplat import SplashSplat, SplashSplatConfig, course, smaller
from splashbench_methods.splashsplat.appearance import fitting, losses
from splashbench_methods.splashsplat.appearance.compositing import composite
from splashbench_methods.splashsplat.appearance.decoder import Children
from splashbench_methods.splashsplat.fields.observations import Observations
from splashbench_methods.splashsplat.kernel.window_loss import WindowPhotograph, window_losses

SMALL = {
    "hull_cells": 32,
    "transport_cells": 16,
    "control_cells": 6,
    "iterations": 60,
    "velocity_steps": 2,
    "self_calibration": False,
    "background_preset": "quick",
}


def test_the_losses_of_an_image_by_torch_are_the_kernels() -> None:
    rng = np.random.default_rng(0)
    photograph = WindowPhotograph(
        torch.from_numpy(rng.integers(0, 256, (20, 30, 3)).astype(np.uint8)),
        torch.from_numpy(rng.random((20, 30)) < 0.6),
        top=3,
        left=5,
    )
    image, alpha = (torch.rand(shape).requires_grad_() for shape in ((31, 44, 3), (31, 44)))
    for theirs, ours in zip(
        window_losses(image, alpha, photograph, True), losses.image_terms_by_torch(image, alpha, photograph, True)
    ):
        assert float(ours.detach()) == pytest.approx(float(theirs.detach()), rel=1e-5)
        expected = torch.autograd.grad(theirs, (image, alpha), retain_graph=True, materialize_grads=True)
        found = torch.autograd.grad(ours, (image, alpha), retain_graph=True, materialize_grads=True)
        for one, other in zip(expected, found):
            assert float((one - other).abs().max()) < 1e-6


def _drawn_elsewhere(
    means: torch.Tensor, factors: torch.Tensor, opacities: torch.Tensor, colors: torch.Tensor | None, views: Any
) -> list[tuple[torch.Tensor, torch.Tensor]]:
    """The CPU's images of what lies on the virtual device, all of it, and back there."""
    given = [factors, opacities, *([] if colors is None else [colors])]
    behind = [view["background"] for view in views if isinstance(view.get("background"), torch.Tensor)]
    assert all(isinstance(tensor, VirtualTensor) for tensor in (*given, *behind))
    on_cpu = [{**view, "background": _moved(view.get("background"))} for view in views]
    images = autograd.rasterize(
        means.cpu(), factors.cpu(), opacities.cpu(), None if colors is None else colors.cpu(), on_cpu
    )
    return [(color.to(DEVICE), opacity.to(DEVICE)) for color, opacity in images]


def _moved(value: Any) -> Any:
    return value.cpu() if isinstance(value, torch.Tensor) else value


@pytest.fixture
def device(monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    original = backends.backend_for

    def backend_for(name: str, means: Any) -> backends.Backend:
        if isinstance(means, VirtualTensor):
            return backends.Backend("virtual", _drawn_elsewhere)
        return original(name, means)

    monkeypatch.setattr(backends, "backend_for", backend_for)
    for module in (course, side_by_side):
        monkeypatch.setattr(module, "thread_count", lambda: 1)  # the device is the thread's own
    with virtual_device() as name, one_torch_thread():
        yield name


def _images(fitted: Fitted, scene: Scene) -> np.ndarray:
    return np.stack([fitted.render(scene.cameras["6"], float(scene.times[t])).rgb for t in (1, 4)])


def _fitted(scene: Scene, device: str, preset: str, settings: dict[str, Any], checkpoints: Path) -> Fitted:
    config = SplashSplatConfig.preset(preset, SMALL | settings)
    run = Run(device=device)
    run._checkpoints = Checkpoints(checkpoints, [0.0, 1e9], lambda: 7.0, lambda: None)
    fitted = SplashSplat().fit(scene.training(), config, run)
    assert list(checkpoints.iterdir())
    return fitted


# Steps of what is stored are chosen by trials, and another step shows in renders more than sums in another order do.
ALONE = {"draft_cells": 0, "storage_tolerance": 0.0}

#: Settings that between them reach every part of a fit.
CASES: dict[str, tuple[str, dict[str, Any]]] = {
    "best": ("best", {"draft_cells": 24, "storage_tolerance": 0.0}),
    "storing": ("best", {"draft_cells": 0, "coarse_grids_share": 0.0}),
    "glass": ("best", ALONE | {"glass": 100, "beside_weight": 0.5, "clear_idle_early": True}),
    "coarse first": ("quick", ALONE | {"coarse_share": 0.4, "coarsest_share": 0.2, "coarse_side": 1}),
    "auto": ("auto", ALONE | {"iterations": 120}),
    "paper": ("paper", {"children": 2, "draft_cells": 0}),
}
#: What `make test` has time for: what most fits are, and how they are stored.
_QUICK = ("storing",)


@pytest.mark.parametrize(
    "case", [pytest.param(case, marks=[] if case in _QUICK else [pytest.mark.slow]) for case in CASES]
)
def test_a_fit_there_is_the_cpus(
    case: str,
    balls: Scene,
    device: str,
    short_background: None,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    request: pytest.FixtureRequest,
) -> None:
    preset, settings = CASES[case]
    if case not in ("best", "paper"):  # these look at it, and draw its Gaussians with the liquid's
        request.getfixturevalue("flat_background")
    monkeypatch.setattr(smaller, "_DRAFT_ITERATIONS", 20)
    monkeypatch.setattr(fitting, "_LOOK_EVERY", 20)
    monkeypatch.setattr(fitting, "_BEFORE", 30)
    if case == "glass":
        monkeypatch.setattr(Observations, "in_transparent_container", property(lambda self: True))
    expected = _images(_fitted(balls, "cpu", preset, settings, tmp_path / "cpu"), balls)
    fitted = _fitted(balls, device, preset, settings, tmp_path / "device")
    images = _images(fitted, balls)
    # Sums in another order end in another fit, a little; and, where a trial goes the other way, in another step.
    assert np.quantile(np.abs(images - expected), 0.99) < (1e-2 if case == "storing" else 1e-3)
    seen_from = (float(balls.times[2]), balls.cameras["6"].center)
    before = fitted.gaussians(*seen_from)
    fitted.to_device(device)
    for ours, theirs in zip(vars(before).values(), vars(fitted.gaussians(*seen_from)).values()):
        assert np.abs(ours - theirs).max(initial=0) < 1e-5
    # A Gaussian at the least opacity that is drawn, 1/255, may be drawn there and not here.
    beside = np.abs(_images(fitted, balls) - images)
    assert np.quantile(beside, 0.999) < 1e-5
    assert beside.max() < 1 / 255


def test_anchors_of_the_background_there(balls: Scene, device: str) -> None:
    torch.manual_seed(0)
    model = AnchorModel(200, StaticAnchorSpec(2))
    for table in (model.positions, model.features.data, model.offsets.data, model.log_scales.data):
        table.normal_()
    camera = balls.cameras["1"]
    with torch.no_grad():
        rows = model.in_view(camera)
        expected = model.decode(camera.center, rows)
        there = copy.deepcopy(model).to(device)
        assert torch.equal(there.in_view(camera).cpu(), rows)
        found = there.decode(camera.center, there.in_view(camera))
    for theirs, ours in zip(expected, found):
        assert isinstance(ours, VirtualTensor)
        assert float(((theirs - ours.cpu()).abs() / (1 + theirs.abs())).max()) < 1e-5


def test_liquid_behind_a_wall_there(balls: Scene, device: str) -> None:
    rng = np.random.default_rng(0)
    n, camera = 40, balls.cameras["1"]
    children = Children(
        torch.from_numpy(rng.normal(scale=0.1, size=(n, 1, 3)).astype(np.float32)),
        0.02 * torch.eye(3).expand(n, 1, 3, 3),
        torch.full((n, 1), 0.7),
        torch.from_numpy(rng.random((n, 1, 3)).astype(np.float32)),
        torch.zeros(n, 1, 3),
    )
    size = camera.height, camera.width
    others = torch.rand(*size, 3), torch.rand(*size), torch.from_numpy(rng.random(n) < 0.5)
    background, wall, in_front = others
    expected = composite(children, camera, background, wall=wall, in_front=in_front)
    background, wall, in_front = (tensor.to(device) for tensor in others)
    found = composite(children.to(device), camera, background, wall=wall, in_front=in_front)
    for theirs, ours in zip(expected, found):
        assert torch.equal(theirs, ours.cpu())
