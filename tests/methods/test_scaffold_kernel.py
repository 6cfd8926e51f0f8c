"""The compiled decoder of static anchors against the model's definition in torch and float64."""

from __future__ import annotations

import copy

import numpy as np
import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st

from splashbench.native.threads import use_threads
from splashbench.render import rasterize
from splashbench.scene import Camera, look_at
from splashbench_methods.scaffold_gs.kernel.decode import Heads, Tables, decode
from splashbench_methods.scaffold_gs.kernel.library import KERNEL
from splashbench_methods.scaffold_gs.model import FEATURES, AnchorModel, DecodedGaussians, StaticAnchorSpec

EYE = np.array([1.0, -2, 4])
_PAIRS = StaticAnchorSpec(2)


def anchors(n: int, seed: int = 0, spec: StaticAnchorSpec = _PAIRS, size: float = 1.0) -> AnchorModel:
    """n anchors at random, about the origin, with heads of some weight."""
    torch.manual_seed(seed)
    model = AnchorModel(n, spec)
    with torch.no_grad():
        model.positions.normal_()
        model.features.normal_()
        model.offsets.normal_()
        model.log_scales.normal_(mean=np.log(size), std=0.5)
        for parameter in model.parameters():
            parameter.add_(0.1 * torch.randn(parameter.shape))
    return model


def outcome(decoded: DecodedGaussians, model: AnchorModel, least: int) -> dict[str, torch.Tensor]:
    """The Gaussians, and the gradients of a sum of all of them with weights. least: outputs, the first ones, that are
    summed."""
    generator = torch.Generator().manual_seed(7)
    dtype = decoded.means.dtype
    weights = [torch.randn(t.shape, generator=generator, dtype=torch.float64).to(dtype) for t in decoded]
    loss = sum((t * weight).sum() for t, weight in list(zip(decoded, weights))[:least])
    names, parameters = zip(*model.named_parameters())
    gradients = torch.autograd.grad(loss, parameters, allow_unused=True)
    zero = {name: torch.zeros_like(p) for name, p in zip(names, parameters)}
    found = {f"grad {name}": zero[name] if g is None else g for name, g in zip(names, gradients)}
    return decoded._asdict() | found


def assert_same(model: AnchorModel, rows: torch.Tensor | None, least: int = 5) -> None:
    """The kernel is as near to what float64 gives as torch in single precision is, or nearly."""
    exact = copy.deepcopy(model).double()
    expected = outcome(exact.decode_by_torch(EYE, rows), exact, least)
    plain = outcome(model.decode_by_torch(EYE, rows), model, least)
    for name, got in outcome(model.decode(EYE, rows), model, least).items():
        assert got.shape == expected[name].shape
        if not got.numel():
            continue
        scale = float(expected[name].detach().abs().max())
        rounding = float((plain[name].detach() - expected[name].detach()).abs().max())
        error = float((got.detach() - expected[name].detach()).abs().max())
        assert error <= 4 * rounding + 5e-6 * scale + 1e-12, f"{name} is off by {error:.2e} of {scale:.2e}"


@settings(deadline=None, max_examples=30)
@given(
    st.integers(1, 700),
    st.integers(1, 10),
    st.booleans(),
    st.booleans(),
    st.booleans(),
    st.integers(1, 5),
    st.integers(0, 99),
)
@example(64, 2, False, True, False, 5, 0)
@example(65, 1, True, False, True, 5, 1)
@example(513, 10, True, True, True, 1, 2)
def test_gaussians_and_gradients_are_those_of_the_definition(n, children, sees, base, some, least, seed):
    model = anchors(n, seed, StaticAnchorSpec(children, sees, base))
    rows = torch.randperm(n)[: n // 2].sort().values if some else None
    assert_same(model, rows, least)


def test_no_anchor_gives_no_gaussian_and_gradients_of_zero():
    for model, rows in ((anchors(0), None), (anchors(5), torch.zeros(0, dtype=torch.int64))):
        found = outcome(model.decode(EYE, rows), model, 5)
        assert found["means"].shape == (0, 3)
        assert all(not value.any() for name, value in found.items() if name.startswith("grad"))


def test_anchors_that_are_not_decoded_have_no_gradient():
    model = anchors(100)
    rows = torch.arange(0, 100, 3)
    found = outcome(model.decode(EYE, rows), model, 5)
    left = torch.ones(100, dtype=torch.bool)
    left[rows] = False
    for name in ("features", "offsets", "log_scales"):
        assert not found[f"grad {name}"][left].any()
        assert found[f"grad {name}"][rows].any()


def test_a_quaternion_of_no_length_stays_finite():
    model = anchors(3)
    with torch.no_grad():
        model.shape_head[2].weight.zero_()
        model.shape_head[2].bias.zero_()
    found = outcome(model.decode(EYE), model, 5)
    assert all(torch.isfinite(found[name]).all() for name in ("factors", "scales", "means"))


def test_threads_change_nothing():
    model = anchors(3000, spec=StaticAnchorSpec(3))
    with use_threads(1):
        alone = outcome(model.decode(EYE), model, 5)
    with use_threads(4):
        together = outcome(model.decode(EYE), model, 5)
    assert all(torch.equal(alone[name], together[name]) for name in alone)


@pytest.mark.parametrize("variant", KERNEL.built_variants())
def test_every_variant_computes_the_same(variant, monkeypatch):
    if not KERNEL.runs(variant):
        pytest.skip(f"this processor does not run {variant}")
    monkeypatch.setitem(KERNEL.__dict__, "library", KERNEL.open_variant(variant))
    assert_same(anchors(300), torch.arange(0, 300, 2))


def test_without_gradients_nothing_is_kept():
    model = anchors(10)
    with torch.no_grad():
        assert not model.decode(EYE).means.requires_grad
    frozen = anchors(10).requires_grad_(False)
    assert not frozen.decode(EYE).means.requires_grad


def test_what_was_changed_since_is_noticed():
    model = anchors(10)
    decoded = model.decode(EYE)
    with torch.no_grad():
        model.features.add_(1)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        decoded.means.sum().backward()


def _pieces() -> tuple[Tables, Heads, torch.Tensor]:
    model = anchors(5)
    parts = (model.opacity_head, model.shape_head, model.color_head)
    weights = tuple(p.detach() for part in parts for p in part.parameters())
    tables = Tables(model.features.detach(), model.offsets.detach(), model.log_scales.detach(), model.positions)
    return tables, Heads(weights, False, True), torch.zeros(3)


@pytest.mark.parametrize(
    ("change", "error", "says"),
    [
        ({"features": torch.zeros(5, FEATURES, dtype=torch.float64)}, TypeError, "features is torch.float64"),
        ({"features": torch.zeros(5, 7)}, ValueError, "tensor 0 is"),
        ({"offsets": torch.zeros(4, 2, 3)}, ValueError, "offsets is"),
        ({"offsets": torch.zeros(5, 0, 3)}, ValueError, "too few"),
        ({"offsets": torch.zeros(5, 6)}, ValueError, r"offsets \[N, K, 3\]"),
        ({"log_scales": torch.zeros(5, 3)}, ValueError, "log_scales is"),
        ({"positions": torch.zeros(5, 4)}, ValueError, "positions is"),
        ({"eye": torch.zeros(2)}, ValueError, "eye is"),
        ({"rows": torch.tensor([0, 5])}, ValueError, "outside 0 to 4"),
        ({"rows": torch.tensor([-1, 2])}, ValueError, "outside 0 to 4"),
        ({"rows": torch.tensor([2, 2])}, ValueError, "not ascending"),
        ({"rows": torch.tensor([2], dtype=torch.int32)}, TypeError, "not int64"),
        ({"weights": ()}, ValueError, "four tensors"),
    ],
)
def test_what_does_not_fit_is_named_before_it_is_read(change, error, says):
    tables, heads, eye = _pieces()
    tables = Tables(**(vars(tables) | {k: v for k, v in change.items() if k in vars(tables)}))
    heads = Heads(change.get("weights", heads.weights), False, True)
    with pytest.raises(error, match=says):
        decode(tables, heads, change.get("eye", eye), change.get("rows"))


def camera(angle: float, focal: float, distance: float) -> Camera:
    eye = distance * np.array([np.cos(angle), np.sin(angle), 0.3])
    K = np.array([[focal, 0, 30], [0, focal, 25], [0, 0, 1]])
    return Camera("1", 64, 48, K, look_at(eye, np.zeros(3), np.array([0.0, 0, 1])))


@settings(deadline=None, max_examples=40)
@given(st.floats(0, 6.28), st.floats(20, 300), st.floats(0.2, 6), st.floats(0.005, 0.3), st.integers(0, 99))
def test_what_a_camera_sees_needs_no_anchor_out_of_its_view(angle, focal, distance, size, seed):
    model = anchors(400, seed, size=size)
    view = camera(angle, focal, distance)
    rows = model.in_view(view)
    with torch.no_grad():
        every, some = (
            rasterize(*model.decode(view.center, chosen)[:4], view, background=torch.zeros(3))[0]
            for chosen in (None, rows)
        )
    assert float((every - some).abs().max()) < 2e-3


def test_what_is_no_number_is_not_left_out_unseen():
    model = anchors(50, size=0.01)
    with torch.no_grad():
        model.log_scales[3, 4] = np.nan
        model.offsets[7, 0, 1] = np.nan
    assert {3, 7} <= set(model.in_view(camera(0.4, 4000.0, 5.0)).tolist())


def test_most_of_what_lies_beside_the_image_is_left_out():
    model = anchors(2000, size=0.01)
    with torch.no_grad():
        model.offsets.mul_(0.1)
    view = camera(0.4, 400.0, 5.0)
    uv, depth = view.project(model.positions.numpy())
    inside = ((uv > 0).all(1) & (uv < [64, 48]).all(1) & (depth > 0)).nonzero()[0]
    rows = model.in_view(view).tolist()
    assert set(inside) <= set(rows)
    assert len(rows) < 2 * len(inside) + 50
