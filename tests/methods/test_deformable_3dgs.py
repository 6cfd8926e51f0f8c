"""Deformable-3DGS: the network against its formula, units, the fit, and what is kept of it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch

from splashbench.gaussians.initialization import StartingPoints
from splashbench.gaussians.mixed_model import MixedFitted
from splashbench.gaussians.photographs import Photographs
from splashbench.gaussians.torch_threads import one_torch_thread
from splashbench.harness.contract import Run
from splashbench.scene import Scene
from splashbench_methods.deformable_3dgs import Deformable3DGS
from splashbench_methods.deformable_3dgs.deformation import Deformation, encode
from splashbench_methods.deformable_3dgs.method import _TimeNoise, rates
from splashbench_methods.deformable_3dgs.model import DeformableModel
from splashbench_methods.deformable_3dgs.settings import DeformableSettings

SMALL = {"iterations": 200, "static_points": 300, "hull_points": 200, "max_gaussians": 700, "width": 16, "depth": 4}


@pytest.fixture(autouse=True)
def _one_thread() -> Iterator[None]:
    with one_torch_thread(), torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        yield


def fit(scene: Scene, directory: Path, seed: int = 0, **settings: object) -> MixedFitted:
    config = DeformableSettings.preset("quick", {**SMALL, **settings})
    assert isinstance(config, DeformableSettings)
    return Deformable3DGS().fit(scene.training(), config, Run(seed=seed, directory=directory))


@pytest.fixture(scope="module")
def fitted(balls: Scene, tmp_path_factory: pytest.TempPathFactory) -> MixedFitted:
    return fit(balls, tmp_path_factory.mktemp("fit"))


class TestNetwork:
    def test_the_published_one_has_506378_parameters(self) -> None:
        assert sum(parameter.numel() for parameter in Deformation().parameters()) == 506_378

    def test_the_encoding_is_the_values_then_sine_and_cosine_by_octave(self) -> None:
        encoded = encode(torch.tensor([[0.1, 0.2]], dtype=torch.float64), 2)[0].numpy()
        x = np.array([0.1, 0.2])
        np.testing.assert_allclose(encoded, np.concatenate([x, np.sin(x), np.cos(x), np.sin(2 * x), np.cos(2 * x)]))

    def test_it_is_the_formula(self) -> None:
        network = Deformation(depth=4, width=8).double()
        network.center.copy_(torch.tensor([1.0, 2, 3]))
        network.unit.fill_(2.0)
        positions = torch.randn(5, 3, dtype=torch.float64)
        inputs = np.concatenate([[encode((p[None] - network.center) / 2)[0].numpy()] for p in positions])
        times = encode(torch.tensor([[0.3]], dtype=torch.float64)).numpy().repeat(5, 0)
        inputs = np.concatenate([inputs, times], axis=1)
        hidden = inputs
        for i, layer in enumerate(network.layers):
            if i == 3:
                hidden = np.concatenate([inputs, hidden], axis=1)
            hidden = np.maximum(hidden @ layer.weight.detach().numpy().T + layer.bias.detach().numpy(), 0)
        for got, head, unit in zip(network(positions, 0.3), (network.shift, network.turn, network.growth), (2, 1, 2)):
            wanted = unit * (hidden @ head.weight.detach().numpy().T + head.bias.detach().numpy())
            np.testing.assert_allclose(got.detach().numpy(), wanted, atol=1e-12)

    def test_a_scene_in_centimetres_is_the_same_scene(self, balls: Scene) -> None:
        models = []
        for factor in (1.0, 100.0):
            torch.manual_seed(1)
            points = np.random.default_rng(0).uniform(-1, 1, (50, 3)).astype(np.float32)
            start = StartingPoints(
                points * factor, points * 0 + 0.5, np.full(50, 0.1 * factor, np.float32), np.full(50, -1)
            )
            models.append(DeformableModel.from_start(start, 0.5, 1, 4, 16))
        small, large = (model.at(0.4) for model in models)
        torch.testing.assert_close(small.means * 100, large.means, rtol=1e-4, atol=1e-3)
        torch.testing.assert_close(small.factors * 100, large.factors, rtol=1e-4, atol=1e-3)
        config = DeformableSettings()
        assert rates(config, 200.0)["positions"].first == pytest.approx(100 * rates(config, 2.0)["positions"].first)


def test_the_published_rates_are_of_one_size_in_the_network_and_quick_heads_learn_slower() -> None:
    parts = [f"deformation.{part}" for part in ("layers", "shift", "turn", "growth")]
    published, quick = (rates(DeformableSettings.preset(name, {}), 1.0) for name in ("paper", "quick"))
    assert {published[part].first for part in parts} == {8e-4}
    assert {published[part].last for part in parts} == {1.6e-6}
    layers, shift, turn, growth = (quick[part].first for part in parts)
    assert growth < shift == turn < layers


@pytest.mark.parametrize(("steps", "positions", "network"), [(20_000, 8e-4 * 0.01 ** (2 / 3), 8e-4 * 0.002**0.5),
                                                             (40_000, 8e-6, 1.6e-6)])  # fmt: skip
def test_published_rates_fall_by_steps_so_that_fits_of_real_scenes_end_before_they_do(
    steps: int, positions: float, network: float
) -> None:
    found = rates(DeformableSettings.preset("paper", {"iterations": steps}), 5.0)
    assert found["positions"].at(1.0) == pytest.approx(positions)
    assert found["deformation.layers"].at(1.0) == pytest.approx(network)


def test_the_times_noise_of_the_preset_paper_is_the_official_codes(balls: Scene) -> None:
    """0.1 of the recording by the photographs left of the round, falling along a line until step 20 000."""
    paper = DeformableSettings.preset("paper", {})
    assert isinstance(paper, DeformableSettings)

    def deviation(config: DeformableSettings, step: int, left: int) -> float:
        noise = _TimeNoise(config, 50, np.random.default_rng(0))
        return float(np.std([noise.at(step, left) for _ in range(4000)]))

    assert deviation(paper, 0, 250) == pytest.approx(0.1 / 250, rel=0.05)
    assert deviation(paper, 5000, 10) == pytest.approx(0.75 * 0.1 / 10, rel=0.05)
    assert deviation(paper, 20_000, 1) == 0
    # A fit on two cores takes 0.1 of a timestep, whatever is left of the round.
    quick = DeformableSettings.preset("quick", {})
    assert isinstance(quick, DeformableSettings)
    assert deviation(quick, 0, 250) == deviation(quick, 0, 1) == pytest.approx(0.1 / 49, rel=0.05)
    photographs = Photographs(balls.training(), 32, 2, np.random.default_rng(0))
    views, frames = len(balls.train), balls.n_frames
    left = []
    for _ in range(3 * frames):
        left.append(photographs.left)
        photographs.next()
    assert left[0] == views * frames
    assert min(left) > 0
    assert sorted(set(left), reverse=True) == left
    assert photographs.left == views * frames  # the next round


def test_positions_get_no_gradient_through_the_network() -> None:
    model = DeformableModel(4, 0, 4, 16)
    with torch.no_grad():
        model.positions.normal_()
    model.at(0.5).means[:, 0].sum().backward()
    assert model.positions.grad is not None
    torch.testing.assert_close(model.positions.grad, torch.tensor([[1.0, 0, 0]]).repeat(4, 1))


class TestFit:
    def test_it_learns_and_says_how_well(self, fitted: MixedFitted) -> None:
        history = fitted.history
        assert history is not None
        assert history.psnr[-10:].mean() > history.psnr[:5].mean() + 1.5

    def test_gaussians_move_with_time(self, fitted: MixedFitted) -> None:
        with torch.no_grad():
            moved = fitted.model.at(1.0).means - fitted.model.at(0.0).means
        assert moved.norm(dim=1).max() > 0.01

    def test_a_loaded_model_renders_the_same(self, fitted: MixedFitted, balls: Scene, tmp_path: Path) -> None:
        fitted.save(tmp_path)
        loaded = Deformable3DGS().load(tmp_path, balls.training())
        camera = balls.cameras[balls.test[0]]
        for time in balls.times[[0, 3]]:
            a, b = fitted.render(camera, float(time)), loaded.render(camera, float(time))
            np.testing.assert_array_equal(a.rgb, b.rgb)
            np.testing.assert_array_equal(a.alpha, b.alpha)
        mine, its = fitted.particles(), loaded.particles()
        assert mine is not None
        assert its is not None
        np.testing.assert_array_equal(mine.positions, its.positions)
        assert (tmp_path / "history.json").is_file()

    def test_one_seed_gives_one_model(self, balls: Scene, tmp_path: Path) -> None:
        first, again, other = (fit(balls, tmp_path, seed, iterations=8) for seed in (3, 3, 4))
        for name, tensor in first.model.state_dict().items():
            assert torch.equal(tensor, again.model.state_dict()[name])
        assert not torch.equal(first.model.state_dict()["positions"], other.model.state_dict()["positions"])

    def test_the_network_waits_for_its_turn(self, balls: Scene, tmp_path: Path) -> None:
        waiting = fit(balls, tmp_path, iterations=5, warm_up=1.0).model
        working = fit(balls, tmp_path, iterations=5, warm_up=0.0).model
        assert waiting.deforms  # after the fit it takes part
        for model, moves in ((waiting, False), (working, True)):
            assert bool(model.deformation.shift.weight.any()) is moves
