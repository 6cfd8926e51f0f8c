"""Decoder, losses and optimiser against values worked out by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from splashbench.render import freeze, rasterize_arrays
from splashbench.scene import Camera
from splashbench_methods.splashsplat.appearance import losses
from splashbench_methods.splashsplat.appearance.averages import ShownHeads
from splashbench_methods.splashsplat.appearance.compositing import _cut, composite
from splashbench_methods.splashsplat.appearance.decoder import Children, Decoder, DecoderSettings
from splashbench_methods.splashsplat.appearance.optimizer import RowAdam
from splashbench_methods.splashsplat.carriers.subframe import CarrierState


def decoder_with_constant_heads(**settings) -> Decoder:
    """Heads that ignore the feature and answer with their biases."""
    decoder = Decoder(DecoderSettings(feature_size=4, **settings))
    with torch.no_grad():
        for head in (decoder.offset, decoder.scale, decoder.opacity):
            head.weight.zero_()
    return decoder


def state(deformation: torch.Tensor, phi: float = 0.0) -> CarrierState:
    return CarrierState(torch.tensor([[1.0, 2.0, 3.0]]), deformation[None], torch.tensor([phi]))


def test_children_start_one_unit_apart_in_the_carriers_frame():
    decoder = decoder_with_constant_heads()
    turn = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])  # x to y
    log_scales = torch.log(torch.tensor([[0.2, 0.1, 0.1]]))
    children = decoder(torch.zeros(1, 4), log_scales, state(turn), torch.zeros(3))
    expected = [[1, 2.1, 3], [1, 1.9, 3]]  # half of s_x = 0.2 to either side, along the turned axis
    np.testing.assert_allclose(children.means[0].detach(), expected, atol=1e-5)
    assert float((children.offsets[0, 0] - children.offsets[0, 1]).detach().norm()) == pytest.approx(1.0, abs=1e-5)


def test_covariance_follows_deformation_and_scale():
    decoder = decoder_with_constant_heads()
    with torch.no_grad():
        decoder.scale.bias.copy_(torch.tensor([0.6, 0, 0, 0, 0, 0]))
    shear = torch.tensor([[1.0, 0.5, 0], [0, 1, 0], [0, 0, 1]])
    base = torch.tensor([0.3, 0.2, 0.1])
    children = decoder(torch.zeros(1, 4), base.log()[None], state(shear), torch.zeros(3))
    grown = 0.5 * 2 * math.tanh(0.3)
    B = shear @ torch.diag(base * torch.tensor([math.exp(grown), 1, 1])) / math.sqrt(2)
    got = children.factors[0, 0]
    np.testing.assert_allclose((got @ got.T).detach(), (B @ B.T).detach(), rtol=1e-5, atol=1e-8)


@pytest.mark.parametrize("answer", [0.6, 5.0])
def test_the_scales_residual_may_be_the_heads_answer_itself(answer: float):
    """Eq. child_position: B = A diag(exp(eta_s g_s(f))) / sqrt(K), whatever g_s answers."""
    decoder = decoder_with_constant_heads(scale_residual="linear")
    with torch.no_grad():
        decoder.scale.bias.copy_(torch.tensor([answer, 0, 0, 0, 0, 0]))
    arguments = torch.zeros(1, 4), torch.zeros(1, 3)
    children = decoder(*arguments, state(torch.eye(3)), torch.zeros(3))
    assert float(children.factors[0, 0, 0, 0].detach()) == pytest.approx(math.exp(0.5 * answer) / math.sqrt(2))
    compiled, _ = decoder.decode(*arguments, None, state(torch.eye(3)), torch.zeros(3))
    assert torch.equal(compiled.factors, children.factors)
    assert compiled.factors.requires_grad


def test_opacity_fades_away_from_the_interface():
    decoder = decoder_with_constant_heads()
    for phi in (0.0, 3.0, -6.0):
        children = decoder(torch.zeros(1, 4), torch.zeros(1, 3), state(torch.eye(3), phi), torch.zeros(3))
        expected = 1 / (1 + math.exp(-1)) / (1 + math.exp(-2 * (3 - abs(phi))))
        np.testing.assert_allclose(children.opacities.detach(), expected, rtol=1e-5)


def test_colour_sees_the_viewing_direction_and_shape_does_not():
    decoder = Decoder(DecoderSettings(feature_size=4))
    feature = torch.randn(1, 4, generator=torch.Generator().manual_seed(0))
    arguments = (feature, torch.zeros(1, 3), state(torch.eye(3)))
    front, side = decoder(*arguments, torch.zeros(3)), decoder(*arguments, torch.tensor([9.0, 0, 0]))
    assert not torch.allclose(front.colors, side.colors)
    assert torch.equal(front.means, side.means)
    assert torch.equal(front.factors, side.factors)


def one_child(depth: float, color: tuple[float, float, float]) -> Children:
    """A Gaussian of a carrier, .2 wide, nearly opaque, in front of a camera at the origin that looks along z."""
    shape = (1, 1)
    return Children(
        torch.tensor([0.0, 0.0, depth]).expand(*shape, 3),
        0.2 * torch.eye(3).expand(*shape, 3, 3),
        torch.full(shape, 0.99),
        torch.tensor(color).expand(*shape, 3),
        torch.zeros(*shape, 3),
    )


def test_liquid_and_background_drawn_together_hide_each_other_by_depth():
    """A red wall at depth 2, liquid in blue; black lies behind."""
    camera = Camera("c", 40, 40, np.array([[40.0, 0, 20], [0, 40, 20], [0, 0, 1]]), np.eye(4))
    wall = (
        np.float32([[0, 0, 2]]),
        0.5 * np.eye(3, dtype=np.float32)[None],
        np.float32([0.99]),
        np.float32([[1, 0, 0]]),
    )
    frozen, black = freeze(*wall, camera), torch.zeros(3)
    before, behind = one_child(1.5, (0.0, 0.0, 1.0)), one_child(3.0, (0.0, 0.0, 1.0))
    rgb, alpha = composite(before, camera, black, frozen)
    assert rgb[20, 20, 2] > 0.9
    assert rgb[20, 20, 0] < 0.1
    hidden_rgb, hidden_alpha = composite(behind, camera, black, frozen)
    assert hidden_rgb[20, 20, 2] < 0.1
    assert hidden_rgb[20, 20, 0] > 0.9
    # The paper's opacity is that of the liquid rasterised alone, hidden or not.
    assert min(alpha[20, 20], hidden_alpha[20, 20]) > 0.9
    assert alpha[0, 0] < 0.01
    assert rgb[8, 20, 0] > 0.3  # the wall stands beside the liquid, too
    # Over an image of the wall the liquid is in front, wherever it is.
    wall_image = torch.from_numpy(rasterize_arrays(*wall, camera)[0])
    assert composite(behind, camera, wall_image)[0][20, 20, 2] > 0.9


def images() -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """A 3x4 image that is 0.1 too bright everywhere, 0.4 at one of the mask's two pixels."""
    target = torch.full((3, 4, 3), 0.2)
    image = target + 0.1
    image[1, 2] = 0.6
    mask = torch.zeros(3, 4)
    mask[1, 1] = mask[1, 2] = 1
    return image, target, mask


def test_foreground_loss_averages_over_the_mask_only():
    assert float(losses.foreground_loss(*images())) == pytest.approx((0.1 + 0.4) / 2, rel=1e-5)


def test_gradient_loss_counts_pairs_that_touch_the_mask():
    # Across: (1,0)-(1,1), (1,1)-(1,2), (1,2)-(1,3); down: two pairs each for columns 1 and 2. The error steps by 0.3
    # on the four pairs that hold pixel (1, 2) and by 0 on the other three.
    assert float(losses.gradient_loss(*images())) == pytest.approx(4 * 0.3 / 7, rel=1e-5)


def test_silhouette_loss_counts_both_sides_of_the_outline():
    mask = torch.zeros(2, 5)
    mask[0] = 1
    alpha = torch.full((2, 5), 0.25)
    assert float(losses.silhouette_loss(alpha, mask, 10)) == pytest.approx((5 * 0.75 + 5 * 0.25) / 10)


def test_covariance_loss_is_the_mean_trace_in_voxels():
    factors = torch.diag(torch.tensor([1.0, 2.0, 3.0]).sqrt()).expand(4, 2, 3, 3)
    assert float(losses.covariance_loss(factors, voxel=2.0)) == pytest.approx(6 / 4)


def test_separation_loss_is_a_squared_hinge():
    offsets = torch.tensor([[[0.0, 0, 0], [0.4, 0, 0]], [[0.0, 0, 0], [0, 0.9, 0]]])
    assert float(losses.separation_loss(offsets)) == pytest.approx(0.2**2 / 2)
    together = torch.zeros(1, 2, 3, requires_grad=True)
    loss = losses.separation_loss(together)
    loss.backward()
    assert float(loss.detach()) == pytest.approx(0.36, rel=1e-4)
    assert torch.isfinite(together.grad).all()
    assert float(losses.separation_loss(torch.zeros(3, 1, 3))) == 0


def test_colour_loss_is_the_variance_within_cells():
    colours = torch.tensor([0.1, 0.3, 0.8])[:, None, None].expand(3, 2, 3)
    cells, sizes = torch.tensor([0, 0, 1]), torch.tensor([2.0, 1.0])
    assert float(losses.color_loss(colours, cells, sizes)) == pytest.approx((0.01 + 0.01 + 0) / 3, rel=1e-5)


def test_row_adam_moves_like_adam_and_leaves_other_rows_alone():
    start = torch.randn(5, 3, generator=torch.Generator().manual_seed(2))
    table, parameter = start.clone(), start[[1, 3]].clone().requires_grad_()
    ours, theirs = RowAdam(table, 0.1), torch.optim.Adam([parameter], lr=0.1)
    rows = torch.tensor([1, 3])
    for step in range(4):
        gradient = torch.full((2, 3), 0.5 + step)
        parameter.grad = gradient.clone()
        theirs.step()
        ours.step(rows, gradient)
    np.testing.assert_allclose(table[rows], parameter.detach(), rtol=1e-5)
    assert torch.equal(table[[0, 2, 4]], start[[0, 2, 4]])


def test_shown_heads_are_means_over_the_last_steps_and_a_decoder_of_their_own() -> None:
    decoder = Decoder(DecoderSettings(feature_size=4, color_width=6))
    shown = ShownHeads(decoder)
    weight = decoder.opacity.weight
    rng = np.random.default_rng(0)
    values = []
    for step in range(400):
        with torch.no_grad():
            # Steps to and fro about what the heads have found.
            weight.fill_(1.0 + rng.normal())
        values.append(float(weight[0, 0].detach()))
        shown.add()
        if step == 0:
            torch.testing.assert_close(shown.decoder().opacity.weight, weight)
    found = float(shown.decoder().opacity.weight[0, 0].detach())
    assert abs(found - 1.0) < 0.5
    share = 0.05
    expected = sum(share * (1 - share) ** age * value for age, value in enumerate(values[::-1]))
    assert found == pytest.approx(expected, abs=1e-4)
    with torch.no_grad():
        shown.decoder().opacity.weight.zero_()
    assert float(weight[0, 0].detach()) == values[-1]
    assert float(shown.decoder().opacity.weight[0, 0].detach()) == found


# The second is large enough for memory that is used again.
@pytest.mark.parametrize("size", [(5, 7), (300, 310)])
@pytest.mark.parametrize("one_color", [False, True])
def test_what_a_wall_cuts_and_its_gradients_are_the_formulas_bits(size: tuple[int, int], one_color: bool) -> None:
    torch.manual_seed(0)
    image, alpha = (torch.rand(shape).requires_grad_() for shape in ((*size, 3), size))
    background, wall = torch.rand(3) if one_color else torch.rand(*size, 3), torch.rand(size).round(decimals=1)
    outer = [torch.randn(*size, 3), torch.randn(size)]
    expected = image + wall[..., None] * (background - image), alpha * (1 - wall)
    found = _cut(image, alpha, background, wall)
    gradients = (torch.autograd.grad(pair, (image, alpha), outer) for pair in (found, expected))
    for one, other in zip((*found, *next(gradients)), (*expected, *next(gradients)), strict=True):
        assert torch.equal(one, other)
