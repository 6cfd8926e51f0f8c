"""Learning rates, rows that come and go with their moments, and orthogonal steps."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from still_gaussians import StillGaussians
from torch import nn

from splashbench.gaussians.optimizer import LearningRate, RowOptimizer


def test_a_rate_begins_falls_and_stays() -> None:
    rate = LearningRate(1.0, 0.01, until=0.5, begin=0.1)
    assert [rate.at(done) for done in (0.05, 0.25, 0.5, 1.0)] == pytest.approx([0, 0.1, 0.01, 0.01])
    held = LearningRate(1.0, 0.01, until=0.6, hold=0.4)
    assert [held.at(done) for done in (0.0, 0.4, 0.5, 0.6, 1.0)] == pytest.approx([1, 1, 0.1, 0.01, 0.01])


def test_a_short_fit_comes_to_rest_before_it_ends() -> None:
    short = LearningRate(0.3, 0.2, until=0.5, begin=0.1).short()
    assert [short.at(done) for done in (0.05, 0.1, 0.3)] == pytest.approx([0, 0.3, 0.3])
    assert 0.0075 < short.at(0.6) < 0.3
    assert [short.at(done) for done in (0.75, 1.0)] == pytest.approx([0.0075, 0.0075])


ROWS = ("positions", "log_scales", "quaternions", "opacity_logits")


def optimizer_of(model: StillGaussians, iterations: int = 100) -> RowOptimizer:
    return RowOptimizer(model, {name: LearningRate.constant(0.01) for name in ROWS}, ROWS, iterations)


class TestRows:
    def test_kept_rows_go_on_as_if_nothing_had_happened(self) -> None:
        targets = torch.randn(6, 3)
        models = [StillGaussians(np.zeros((6, 3))) for _ in range(2)]
        optimizers = [optimizer_of(model) for model in models]
        for step in range(8):
            kept = torch.arange(6) if step < 4 else torch.tensor([1, 4])
            for i, (model, optimizer) in enumerate(zip(models, optimizers)):
                rows = torch.arange(2) if i == 1 and step >= 4 else kept
                ((model.positions[rows] - targets[kept]) ** 2).sum().backward()
                optimizer.step()
            if step == 3:
                new = {name: models[1].get_parameter(name).detach()[:1] + 7 for name in ROWS}
                optimizers[1].replace_rows(np.array([1, 4]), new)
        torch.testing.assert_close(models[1].positions[:2], models[0].positions[[1, 4]])
        assert len(models[1].positions) == 3

    def test_values_that_are_set_have_no_momentum(self) -> None:
        model = StillGaussians(np.zeros((2, 3)))
        optimizer = optimizer_of(model)
        for _ in range(3):
            model.positions.sum().backward()
            optimizer.step()
        optimizer.set_rows("positions", torch.ones(1, 3), torch.tensor([1]))
        (model.positions * 0).sum().backward()
        optimizer.step()
        torch.testing.assert_close(model.positions[1], torch.ones(3))
        assert (model.positions[0] < -0.03).all()  # its momentum goes on


def test_an_orthogonal_step_turns_every_direction_of_a_matrix_by_as_much() -> None:
    network = nn.Sequential(nn.Linear(16, 8), nn.Linear(8, 2))
    first, bias, last = (p.detach().clone() for p in (network[0].weight, network[0].bias, network[1].weight))
    rates = {"0": LearningRate.constant(0.01), "1": LearningRate.constant(0.01)}
    optimizer = RowOptimizer(network, rates, (), 10, orthogonal=("0",))
    strong = torch.zeros(8, 16)
    strong[0] = 100.0
    pull = strong + torch.randn(8, 16)
    (network[0].weight * pull).sum().backward()
    network[0].bias.grad, network[1].weight.grad = torch.ones(8), torch.ones(2, 8)
    optimizer.step()
    step = (network[0].weight.detach() - first).double()
    sizes = torch.linalg.svdvals(step)
    assert sizes.min() > 0.4 * sizes.max()
    assert float((step * pull).sum()) < 0
    # As large as a step of Adam, .2 of the rate on the mean; its bias takes a tenth of Adam's, others Adam's own.
    assert float(step.square().mean().sqrt()) == pytest.approx(0.2 * 0.01, rel=0.3)
    torch.testing.assert_close(network[0].bias.detach(), bias - 0.001)
    torch.testing.assert_close(network[1].weight.detach(), last - 0.01)
    assert network[0].weight.grad is None
