"""Random small scenes, the awkward ones above all, against the definition in float64."""

from __future__ import annotations

import numpy as np
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from splashbench.render import rasterize
from splashbench.scene.camera import Camera

NAMES = ("means", "factors", "opacities", "colors")
SHAPES = ("ball", "needle", "disc", "point", "any")
PLACES = ("inside", "behind", "near plane", "edge", "beyond")


@st.composite
def scenes(draw: st.DrawFn) -> tuple[list[np.ndarray], Camera, dict]:
    """Gaussians (float64 values that float32 holds exactly), a camera, and options."""
    width, height = draw(st.integers(1, 150)), draw(st.integers(1, 80))
    focal = draw(st.floats(20, 200))
    K = np.array(
        [[focal, 0, draw(st.floats(-0.2, 1.2)) * width], [0, focal, draw(st.floats(-0.2, 1.2)) * height], [0, 0, 1]]
    )
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    axis = rng.normal(size=3)
    angle = draw(st.floats(0, 3))
    x, y, z = axis / np.linalg.norm(axis) * angle
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    w2c = np.eye(4)
    w2c[:3, :3] = np.eye(3) + np.sin(angle) / max(angle, 1e-9) * cross
    w2c[:3, :3] += (1 - np.cos(angle)) / max(angle**2, 1e-18) * cross @ cross
    w2c[:3, 3] = rng.normal(size=3)
    camera = Camera("random", width, height, K, w2c)

    n, channels = draw(st.integers(0, 40)), draw(st.sampled_from([1, 2, 3, 4, 5]))
    places = rng.choice(draw(st.lists(st.sampled_from(PLACES), min_size=1, max_size=3)), n)
    depth = rng.uniform(0.5, 6, n)
    depth[places == "behind"] *= -1
    near = places == "near plane"
    depth[near] = rng.uniform(0.005, 0.3, near.sum())
    across = rng.uniform(0, 1, (n, 2))
    edge = places == "edge"
    across[edge, 0] = rng.choice([0.0, 1.0], edge.sum()) + rng.normal(size=edge.sum()) * 0.05
    beyond = places == "beyond"
    across[beyond] = 0.5 + rng.choice([-1, 1], (beyond.sum(), 2)) * rng.uniform(0.5, 1.5, (beyond.sum(), 2))
    pixels = across * [width, height]
    local = (
        np.stack([(pixels[:, 0] - K[0, 2]) / focal, (pixels[:, 1] - K[1, 2]) / focal, np.ones(n)], 1) * depth[:, None]
    )
    means = (local - w2c[:3, 3]) @ w2c[:3, :3]

    shapes = rng.choice(draw(st.lists(st.sampled_from(SHAPES), min_size=1, max_size=3)), n)
    scales = {
        "ball": (1, 1, 1),
        "needle": (2, 0.001, 0.001),
        "disc": (1, 1, 0),
        "point": (0, 0, 0),
        "any": (1, 0.3, 0.1),
    }
    size = np.abs(depth) * rng.uniform(2, 15, n) / focal
    turn, _ = np.linalg.qr(rng.normal(size=(n, 3, 3)))
    factors = turn * (np.array([scales[s] for s in shapes]).reshape(n, 1, 3) * size[:, None, None])
    opacities = rng.uniform(0, 1, n)
    for value in draw(st.lists(st.sampled_from([0.0, 1.0, 1 / 255, 0.999]), max_size=2)):
        opacities[rng.random(n) < 0.3] = value
    arrays = [means, factors, opacities, rng.uniform(0, 1, (n, channels))]
    arrays = [a.astype(np.float32).astype(np.float64) for a in arrays]
    options = {
        "background": None if draw(st.booleans()) else torch.as_tensor(rng.uniform(0, 1, channels)),
        "depth": draw(st.booleans()),
    }
    return arrays, camera, options


# As many scenes are looked at as are compared. Which they are also depends on the modules that are loaded, from whose
# numbers hypothesis draws.
EXAMPLES = 150


@settings(max_examples=EXAMPLES, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow])
@given(scene=scenes())
def test_images_and_gradients_match_the_definition(reference, scene):
    arrays, camera, options = scene
    exact = [torch.tensor(a, requires_grad=True) for a in arrays]
    fast = [torch.tensor(a, dtype=torch.float32, requires_grad=True) for a in arrays]
    # Float32 has fewer digits the farther a Gaussian's center lies outside: what it may flip is judged generously.
    smooth = ~reference.threshold_pixels(*[t.detach() for t in exact[:3]], camera, tolerance=1e-2)
    images, expected = rasterize(*fast, camera, **options), reference.rasterize(*exact, camera, **options)
    for got, wanted in zip(images, expected):
        assert torch.isfinite(got).all()
        scale = max(1.0, float(wanted.detach().abs().max()) if wanted.numel() else 1.0)
        torch.testing.assert_close(got[smooth].double(), wanted[smooth], rtol=0, atol=1e-4 * scale)

    generator = torch.Generator().manual_seed(0)
    losses = [torch.zeros(()), torch.zeros((), dtype=torch.float64)]
    for got, wanted in zip(images, expected):
        weight = torch.randn(got.shape, generator=generator, dtype=torch.float64)
        weight = weight * (smooth[..., None] if got.ndim == 3 else smooth)
        losses[0] = losses[0] + (got * weight.float()).sum()
        losses[1] = losses[1] + (wanted * weight).sum()
    for loss in losses:
        loss.backward()
    for name, got, wanted in zip(NAMES, fast, exact):
        assert torch.isfinite(got.grad).all()
        reach = float(wanted.grad.norm()) if wanted.numel() else 0.0
        error = float((got.grad.double() - wanted.grad).norm())
        assert error <= 2e-4 * reach + 1e-6, f"{name}: {error / max(reach, 1e-12):.1e} of {reach:.1e}"


def test_the_random_scenes_are_worth_testing(reference):
    """Most of them draw something, and some draw Gaussians that the pixel test calls doubtful."""
    drawn, doubtful = 0, 0

    @settings(
        max_examples=EXAMPLES,
        deadline=None,
        derandomize=True,
        database=None,
        suppress_health_check=[HealthCheck.too_slow],
    )
    @given(scene=scenes())
    def look(scene):
        nonlocal drawn, doubtful
        arrays, camera, _ = scene
        tensors = [torch.as_tensor(a) for a in arrays]
        drawn += bool((reference.rasterize(*tensors, camera)[1] > 0.05).any())
        doubtful += bool(reference.threshold_pixels(*tensors[:3], camera).any())

    look()
    assert drawn > EXAMPLES * 0.5
    assert doubtful > EXAMPLES * 0.2
