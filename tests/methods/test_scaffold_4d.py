"""4D-Scaffold-GS: the decoder against its formulas, growth in space-time, units, the fit, and what is kept of it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from splashbench.errors import SplashbenchError
from splashbench.gaussians.initialization import StartingPoints
from splashbench.gaussians.mixed_model import MixedFitted
from splashbench.gaussians.torch_threads import one_torch_thread
from splashbench.harness.contract import Run
from splashbench.render.constants import MIN_ALPHA
from splashbench.scene import Camera, Scene
from splashbench_methods.scaffold_4d import Scaffold4D
from splashbench_methods.scaffold_4d.growth import SpacetimeGrowth
from splashbench_methods.scaffold_4d.model import SpacetimeAnchors, SpacetimeAnchorSpec
from splashbench_methods.scaffold_4d.settings import Scaffold4DSettings
from splashbench_methods.scaffold_gs.optimizer import AnchorOptimizer

SMALL = {"iterations": 60, "views_per_step": 2, "static_points": 300, "hull_points": 400, "max_anchors": 900}
TIMES = np.linspace(0, 1, 11)


@pytest.fixture(autouse=True)
def _one_thread() -> Iterator[None]:
    with one_torch_thread(), torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        yield


def look() -> Camera:
    w2c = np.eye(4)
    w2c[2, 3] = 3
    return Camera("1", 96, 64, np.array([[96.0, 0, 48], [0, 96.0, 32], [0, 0, 1]]), w2c)


def start_of(count: int, unit: float = 1.0) -> StartingPoints:
    """Half static points, half points of the hull at the frames in turn."""
    positions = np.random.default_rng(0).uniform(-0.8, 0.8, (count, 3)).astype(np.float32)
    frame = np.where(np.arange(count) % 2, np.arange(count) % len(TIMES), -1)
    return StartingPoints(
        positions * unit, np.full((count, 3), 0.4, np.float32), np.full(count, 0.1 * unit, np.float32), frame
    )


def model_of(count: int = 12, unit: float = 1.0, **variant: object) -> SpacetimeAnchors:
    torch.manual_seed(1)
    chosen = SpacetimeAnchorSpec(**{"children": 3, "base_color": True, "fastest": 2.0 * unit, **variant})  # type: ignore[arg-type]
    return SpacetimeAnchors.from_start(start_of(count, unit), chosen, 0.6, 0.15, TIMES)


def layers(head: torch.nn.Sequential, inputs: np.ndarray) -> np.ndarray:
    first, second = head[0], head[2]
    hidden = np.maximum(inputs @ first.weight.detach().numpy().T + first.bias.detach().numpy(), 0)
    return np.asarray(hidden @ second.weight.detach().numpy().T + second.bias.detach().numpy())


@pytest.mark.parametrize("base_color", [True, False])
def test_children_are_those_of_the_formulas(base_color: bool) -> None:
    model = model_of(base_color=base_color)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(0.2 * torch.randn_like(parameter))
    model = model.double()
    camera, tau = look(), 0.37
    state = model.at(tau)
    splats = model.splats(state, camera)
    shown = 0
    for i in range(len(model)):
        f, a = model.features[i].detach().numpy(), model.positions[i].numpy()
        s, o = np.exp(model.log_scales[i].detach().numpy()), model.offsets[i].detach().numpy()
        rho, shape = np.tanh(layers(model.opacity_head, f)), layers(model.shape_head, f).reshape(3, 8)
        velocity = 2.0 * np.tanh(layers(model.flow_head, f)).reshape(3, 3)
        direction = (a[:3] - camera.center) / np.linalg.norm(a[:3] - camera.center)
        logits = layers(model.color_head, np.concatenate([f, direction])).reshape(3, 3)
        alphas = []
        for k in range(3):
            since = a[3] + o[k, 3] * s[3] - tau
            sigma = (shape[k, 3] if shape[k, 3] > 0 else np.exp(shape[k, 3]) - 1) + 1
            alphas.append(rho[k] * np.exp(-(abs(since * sigma / s[7]) ** 4)))
        row = np.flatnonzero(state.anchors.numpy() == i)
        assert len(row) == int(max(alphas) >= 0.9 * MIN_ALPHA)  # the others could not be seen
        if not len(row):
            continue
        shown += 1
        for k in range(3):
            j = int(row[0]) * 3 + k
            since = a[3] + o[k, 3] * s[3] - tau
            np.testing.assert_allclose(splats.means[j].detach(), a[:3] + o[k, :3] * s[:3] + velocity[k] * since)
            assert float(splats.opacities[j].detach()) == pytest.approx(alphas[k])
            turn = Rotation.from_quat(shape[k, [5, 6, 7, 4]]).as_matrix()
            wanted = turn * (s[4:7] / (1 + np.exp(-shape[k, :3])))
            np.testing.assert_allclose(splats.factors[j].detach(), wanted, atol=1e-10)
            base = f[:3] if base_color else 0
            np.testing.assert_allclose(splats.colors[j].detach(), 1 / (1 + np.exp(-(logits[k] + base))), rtol=1e-6)
            assert splats.rows is not None
            assert int(splats.rows[j]) == i * 3 + k
            np.testing.assert_allclose(model.means(tau)[i * 3 + k].detach(), splats.means[j].detach())
    assert 0 < shown < len(model)


def test_growth_comes_at_least_every_so_many_steps() -> None:
    with pytest.raises(SplashbenchError, match="grow_every"):
        Scaffold4DSettings.preset("quick", {"grow_every": 100_001})


def test_static_anchors_last_and_those_of_the_hull_come_and_go() -> None:
    model = model_of(40)
    static = start_of(40).frame < 0
    shown = [set(model.at(float(t)).anchors.tolist()) for t in TIMES]
    assert all(set(np.flatnonzero(static)) <= seen for seen in shown)
    for i in np.flatnonzero(~static):
        lives = [i in seen for seen in shown]
        assert lives[start_of(40).frame[i]]
        assert sum(lives) <= 6  # 1.5 frames, down to a grey level: 2.3 before and after, and what the offsets add


def test_a_scene_in_centimetres_is_the_same_scene() -> None:
    small, large = model_of(unit=1.0).at(0.4), model_of(unit=100.0).at(0.4)
    torch.testing.assert_close(small.means * 100, large.means, rtol=1e-4, atol=1e-3)
    torch.testing.assert_close(small.factors * 100, large.factors, rtol=1e-4, atol=1e-3)
    torch.testing.assert_close(small.penalty, large.penalty, rtol=1e-3, atol=1e-6)


class TestGrowth:
    def grown(self, pulled: list[tuple[int, float]]) -> tuple[SpacetimeAnchors, int]:
        """A model after a round in which the loss pulled hard at children of anchors, at times."""
        model = model_of(20)
        config = Scaffold4DSettings.preset(
            "quick", {"iterations": 100, "grow_from": 0, "grow_until": 1, "grow_every": 1}
        )
        assert isinstance(config, Scaffold4DSettings)
        optimizer = AnchorOptimizer(model, "short", 100)
        growth = SpacetimeGrowth(optimizer, 0.02, 0.1, config, np.random.default_rng(0))
        for anchor, time in pulled:
            for _ in range(60):
                state = model.at(time)
                splats = model.splats(state, look())
                gradients = torch.full_like(splats.means, 1e-7)
                gradients[(splats.rows // 3 == anchor) & (splats.opacities > 0.3)] = 5.0
                growth.observe(look(), splats, gradients.detach())
        before = len(model)
        growth.after_step(0)
        return model, before

    def test_anchors_appear_where_and_when_the_loss_pulls(self) -> None:
        anchor = 5  # of the hull, at frame 5
        model, before = self.grown([(anchor, 0.5)])
        new = model.positions[before:]
        assert len(new) > 0
        old = model.means(0.5).view(-1, 3, 3)[anchor]
        distance = torch.cdist(new[:, :3], old.detach()).min(dim=1).values
        assert distance.max() < 0.4
        assert (new[:, 3] - 0.5).abs().max() < 0.25

    def test_times_are_told_apart(self) -> None:
        early, late = self.grown([(1, 0.1)]), self.grown([(9, 0.9)])
        assert early[0].positions[early[1] :, 3].mean() < 0.35
        assert late[0].positions[late[1] :, 3].mean() > 0.65

    def test_nothing_grows_where_nothing_pulls(self) -> None:
        model, before = self.grown([])
        assert len(model) <= before


def fit(scene: Scene, directory: Path, seed: int = 0, **settings: object) -> MixedFitted:
    config = Scaffold4DSettings.preset("quick", {**SMALL, **settings})
    assert isinstance(config, Scaffold4DSettings)
    return Scaffold4D().fit(scene.training(), config, Run(seed=seed, directory=directory))


@pytest.fixture(scope="module")
def fitted(balls: Scene, tmp_path_factory: pytest.TempPathFactory) -> MixedFitted:
    """Fitted to the shared scene of balls."""
    return fit(balls, tmp_path_factory.mktemp("fit"))


class TestFit:
    def test_it_learns(self, fitted: MixedFitted) -> None:
        assert fitted.history is not None
        assert fitted.history.psnr[-10:].mean() > fitted.history.psnr[:5].mean() + 1.5

    def test_a_loaded_model_renders_the_same(self, fitted: MixedFitted, balls: Scene, tmp_path: Path) -> None:
        fitted.save(tmp_path)
        loaded = Scaffold4D().load(tmp_path, balls.training())
        camera = balls.cameras[balls.test[0]]
        for time in balls.times[[0, 4]]:
            a, b = fitted.render(camera, float(time)), loaded.render(camera, float(time))
            np.testing.assert_array_equal(a.rgb, b.rgb)
            np.testing.assert_array_equal(a.alpha, b.alpha)
        particles = loaded.particles()
        assert particles is not None
        assert particles.active.any()

    def test_one_seed_gives_one_model(self, balls: Scene, tmp_path: Path) -> None:
        first, again = (fit(balls, tmp_path, 3, iterations=10) for _ in range(2))
        for name, tensor in first.model.state_dict().items():
            assert torch.equal(tensor, again.model.state_dict()[name])
