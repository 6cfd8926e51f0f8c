"""Density control: Gaussians are cloned, split, pruned and reset."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from still_gaussians import StillGaussians

from splashbench.gaussians.density_control import DensityControl, DensitySettings
from splashbench.gaussians.dynamic_model import Splats
from splashbench.gaussians.optimizer import LearningRate, RowOptimizer
from splashbench.scene import Camera

ROWS = ("positions", "log_scales", "quaternions", "opacity_logits")


def optimizer_of(model: StillGaussians, iterations: int = 100) -> RowOptimizer:
    return RowOptimizer(model, {name: LearningRate.constant(0.01) for name in ROWS}, ROWS, iterations)


def look() -> Camera:
    w2c = np.eye(4)
    w2c[2, 3] = 3
    return Camera("1", 96, 64, np.array([[96.0, 0, 48], [0, 96.0, 32], [0, 0, 1]]), w2c)


def density_of(model: StillGaussians, **changes: float) -> DensityControl:
    settings = {"start": 0, "stop": 100, "every": 1, "gradient": 1.0, "large": 0.1, "max_gaussians": 100, **changes}
    return DensityControl(optimizer_of(model), DensitySettings(**settings))  # type: ignore[arg-type]


def pull(model: StillGaussians, density: DensityControl, rows: list[int]) -> None:
    """One view in which the loss pulls hard at `rows` and a little at the others."""
    gradients = torch.full((len(model.positions), 3), 1e-4)
    gradients[rows] = 10.0
    density.observe(look(), model.splats(None, look()), gradients)


class TestDensity:
    def test_small_ones_are_cloned_where_the_loss_pulls(self) -> None:
        model = StillGaussians(np.arange(12).reshape(4, 3) / 20)
        density = density_of(model)
        pull(model, density, [2])
        density.after_step(0)
        assert len(model.positions) == 5
        torch.testing.assert_close(model.positions[4], model.positions[2])
        torch.testing.assert_close(model.log_scales[4], model.log_scales[2])

    def test_what_a_view_leaves_out_is_not_judged_by_it(self) -> None:
        model = StillGaussians(np.array([[-0.5, 0, 0], [0, 0, 0], [0.5, 0, 0]]), scale=0.05)
        density = density_of(model)
        seen, rows = model.splats(None, look()), torch.tensor([0, 2])
        tables = (seen.means, seen.factors, seen.opacities, seen.colors)
        some = Splats(*(table[rows] for table in tables), rows=rows)
        density.observe(look(), some, torch.tensor([[1e-4] * 3, [10.0] * 3]))
        density.after_step(0)
        np.testing.assert_allclose(model.positions.detach()[:, 0], [-0.5, 0, 0.5, 0.5], atol=1e-6)

    def test_large_ones_are_split_within_themselves(self) -> None:
        model = StillGaussians(np.zeros((400, 3)), scale=0.5)
        density = density_of(model, max_gaussians=1000)
        pull(model, density, list(range(400)))
        density.after_step(0)
        assert len(model.positions) == 800
        torch.testing.assert_close(torch.exp(model.log_scales), torch.full((800, 3), 0.5 / 1.6))
        spread = model.positions.detach().numpy()
        assert spread.std(axis=0) == pytest.approx([0.5] * 3, rel=0.1)
        assert abs(np.corrcoef(spread[:400, 0], spread[400:, 0])[0, 1]) < 0.15

    def test_a_faint_one_goes_without_a_clone_however_hard_the_loss_pulls(self) -> None:
        model = StillGaussians(np.arange(9).reshape(3, 3) / 20)
        with torch.no_grad():
            model.opacity_logits[1] = -9.0
        density = density_of(model)
        pull(model, density, [1])
        density.after_step(0)
        np.testing.assert_allclose(model.positions.detach()[:, 0], [0.0, 0.3])

    def test_faint_ones_go_and_the_strongest_pulls_come_first_within_the_limit(self) -> None:
        model = StillGaussians(np.zeros((6, 3)))
        with torch.no_grad():
            model.opacity_logits[0] = -9.0
        density = density_of(model, max_gaussians=7)
        pull(model, density, [0, 3, 4, 5])
        density.observe(look(), model.splats(None, look()), torch.tensor([0.0, 0, 0, 0, 99, 99])[:, None].repeat(1, 3))
        with torch.no_grad():
            model.positions[4:, 0] = torch.tensor([4.0, 5.0])
        density.after_step(0)
        assert model.positions[:, 0].tolist() == [0, 0, 0, 4, 5, 4, 5]

    def test_a_model_of_faint_ones_keeps_one(self) -> None:
        model = StillGaussians(np.zeros((3, 3)), opacity=1e-4)
        density = density_of(model)
        density.after_step(0)
        assert len(model.positions) == 1

    def test_pruning_goes_on_after_growth(self) -> None:
        model = StillGaussians(np.zeros((3, 3)))
        density = density_of(model, stop=5, prune_until=10)
        with torch.no_grad():
            model.opacity_logits[1] = -9.0
        pull(model, density, [0, 2])
        density.after_step(7)
        assert len(model.positions) == 2

    def test_opacities_are_reset_at_their_steps_alone(self) -> None:
        model = StillGaussians(np.zeros((3, 3)), opacity=0.9)
        density = density_of(model, start=1000, reset_every=10, reset_until=25)
        density.after_step(8)
        assert torch.sigmoid(model.opacity_logits).tolist() == pytest.approx([0.9] * 3)
        density.after_step(9)
        assert torch.sigmoid(model.opacity_logits).tolist() == pytest.approx([0.01] * 3)
        with torch.no_grad():
            model.opacity_logits.fill_(2.0)
        density.after_step(29)
        assert model.opacity_logits.tolist() == [2.0] * 3
