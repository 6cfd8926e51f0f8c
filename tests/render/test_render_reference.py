"""The definition in reference.py against answers worked out by hand, a blend in plain numpy, and finite differences."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from splashbench.scene.camera import Camera

MIN_ALPHA, MAX_ALPHA, MIN_TRANSMITTANCE, BLUR = 1 / 255, 0.999, 1e-4, 0.3


def facing_camera(width: int = 40, height: int = 24, cx: float = 20.5, cy: float = 12.5) -> Camera:
    """At the origin, looking along +z, 50 px of focal length; the axis falls on the centre of pixel (12, 20)."""
    return Camera("facing", width, height, np.array([[50.0, 0, cx], [0, 50.0, cy], [0, 0, 1]]), np.eye(4))


def turned_camera(width: int = 45, height: int = 37) -> Camera:
    """Turned about y, 4 units from the origin, its principal point off the center."""
    c, s = math.cos(0.4), math.sin(0.4)
    w2c = np.array([[c, 0, s, 0.1], [0, 1, 0, -0.05], [-s, 0, c, 4.0], [0, 0, 0, 1]])
    return Camera("turned", width, height, np.array([[60.0, 0, 27.1], [0, 55.0, 15.3], [0, 0, 1]]), w2c)


def on_axis(*depths_and_opacities, deviation=2.0, dtype=torch.float64):
    """Round Gaussians on the optical axis, and one-hot colors: channel k shows the weight of Gaussian k."""
    n = len(depths_and_opacities)
    depths, opacities = zip(*depths_and_opacities)
    means = torch.zeros((n, 3), dtype=dtype)
    means[:, 2] = torch.tensor(depths, dtype=dtype)
    factors = deviation * torch.eye(3, dtype=dtype).repeat(n, 1, 1)
    return means, factors, torch.tensor(opacities, dtype=dtype), torch.eye(n, dtype=dtype)


def cloud(n: int, seed: int = 0, channels: int = 3, size: float = 0.09, faintest: float = 0.05):
    """Anisotropic Gaussians around the origin, some of them clamped."""
    rng = np.random.default_rng(seed)
    arrays = (
        rng.normal(size=(n, 3)) * 0.8,
        rng.normal(size=(n, 3, 3)) * size,
        rng.uniform(faintest, 1.0, n),
        rng.uniform(size=(n, channels)),
    )
    return tuple(torch.tensor(array) for array in arrays)


def at_axis(images) -> tuple[list[float], float]:
    """Color and opacity of pixel (12, 20) of `facing_camera`."""
    return images[0][12, 20].tolist(), images[1][12, 20].item()


def blend_one_by_one(means, factors, opacities, colors, camera):
    """(color, opacity, depth) in numpy: every Gaussian at every pixel in turn, Jacobians by central differences.

    The Jacobian is taken at the mean, moved sideways to where it is seen within 15% beyond the image's edges.
    """
    size = np.array([camera.width, camera.height])
    rows, columns = np.mgrid[: camera.height, : camera.width] + 0.5
    centers, depths = camera.project(means)
    color = np.zeros((camera.height, camera.width, colors.shape[1]))
    depth, through, open_ = np.zeros(rows.shape), np.ones(rows.shape), np.ones(rows.shape, bool)
    for i in np.argsort(depths):
        if depths[i] < 0.01:
            continue
        seen = np.clip(centers[i], -0.15 * size, 1.15 * size)
        local = depths[i] * np.linalg.solve(camera.K, [*seen, 1])
        at, steps = camera.w2c[:3, :3].T @ (local - camera.w2c[:3, 3]), 1e-6 * np.eye(3)
        J = (camera.project(at + steps)[0] - camera.project(at - steps)[0]).T / 2e-6
        covariance = J @ factors[i] @ factors[i].T @ J.T + BLUR * np.eye(2)
        offset = np.stack([columns - centers[i, 0], rows - centers[i, 1]], -1)
        distance = np.einsum("hwi,ij,hwj->hw", offset, np.linalg.inv(covariance), offset)
        alpha = np.minimum(opacities[i] * np.exp(-distance / 2), MAX_ALPHA)
        alpha[alpha < MIN_ALPHA] = 0
        open_ &= through * (1 - alpha) > MIN_TRANSMITTANCE
        weight = np.where(open_, alpha * through, 0)
        color += weight[..., None] * colors[i]
        depth += weight * depths[i]
        through -= weight
    return color, 1 - through, depth


@pytest.mark.parametrize("seed", [0, 1])
def test_images_are_those_of_a_blend_one_by_one(reference, seed):
    camera, gaussians = turned_camera(), cloud(150, seed, size=0.12)
    color, opacity = reference.rasterize(*gaussians, camera, depth=True)
    expected, expected_opacity, depth = blend_one_by_one(*[t.numpy() for t in gaussians], camera)
    assert (expected_opacity > 0.999).any()  # stops, too, are put to the test
    assert (expected_opacity == 0).any()
    np.testing.assert_allclose(opacity, expected_opacity, atol=1e-7)
    np.testing.assert_allclose(color[..., :3], expected, atol=1e-7)
    np.testing.assert_allclose(color[..., 3], depth, atol=1e-6)


def test_one_gaussian_has_the_closed_form(reference):
    # Axes of .3 and .1 units, turned by 30 degrees, seen at depth 5 with 50 px of focal length: 3 and 1 px.
    c, s = math.cos(math.pi / 6), math.sin(math.pi / 6)
    factor = (
        torch.tensor([[c, -s, 0], [s, c, 0], [0, 0, 1]]).double() @ torch.diag(torch.tensor([0.3, 0.1, 0.2])).double()
    )
    mean = torch.tensor([[0.0, 0, 5]]).double()
    _, opacity = reference.rasterize(mean, factor[None], torch.tensor([0.6]).double(), None, facing_camera())
    rows, columns = np.mgrid[:24, :40] + 0.5
    along, across = c * (columns - 20.5) + s * (rows - 12.5), -s * (columns - 20.5) + c * (rows - 12.5)
    expected = 0.6 * np.exp(-(along**2 / (9 + BLUR) + across**2 / (1 + BLUR)) / 2)
    np.testing.assert_allclose(opacity, np.where(expected >= MIN_ALPHA, expected, 0), atol=1e-8)


@pytest.mark.parametrize(("axis", "limit"), [(0, (40 + 0.15 * 40 - 20.5) / 50), (1, (24 + 0.15 * 24 - 12.5) / 50)])
def test_beyond_the_image_the_projection_is_linearized_at_its_margin(reference, axis, limit):
    mean = torch.tensor([[0.0, 0, 5]]).double()
    mean[0, axis] = 10.0  # a slope of 2, far beyond the limit
    splats = reference.project(mean, torch.eye(3).double()[None], torch.ones(1).double(), facing_camera())
    assert splats.centers[0, axis] == pytest.approx((20.5, 12.5)[axis] + 100)
    # A row of J is 50 / 5 (1, 0, -slope).
    assert splats.covariances[0, 2 * axis] == pytest.approx(100 * (1 + limit**2) + BLUR)


def test_light_passes_from_front_to_back(reference):
    images = reference.rasterize(*on_axis((6, 0.8), (4, 0.5), (5, 0.2)), facing_camera())
    weights, opacity = at_axis(images)
    assert weights == pytest.approx([0.8 * 0.5 * 0.8, 0.5, 0.2 * 0.5])
    assert opacity == pytest.approx(1 - 0.2 * 0.5 * 0.8)


def test_gaussians_of_equal_depth_keep_their_order(reference):
    weights, _ = at_axis(reference.rasterize(*on_axis((4, 0.5), (4, 0.5), (4, 0.5)), facing_camera()))
    assert weights == pytest.approx([0.5, 0.25, 0.125])


def test_depth_is_the_weighted_sum_and_has_no_background(reference):
    color, _ = reference.rasterize(
        *on_axis((4, 0.5), (6, 0.5)), facing_camera(), background=torch.tensor([0.1, 0.2]).double(), depth=True
    )
    assert color[12, 20].tolist() == pytest.approx([0.5 + 0.025, 0.25 + 0.05, 0.5 * 4 + 0.25 * 6])
    color, _ = reference.rasterize(*on_axis((4, 0.5))[:3], None, facing_camera(), depth=True)
    assert color.shape == (24, 40, 1)
    assert color[12, 20, 0] == pytest.approx(2)


def test_alpha_is_clamped_and_passes_no_gradient_there(reference):
    inputs = [tensor.requires_grad_() for tensor in on_axis((4, 1.0))]
    color, opacity = reference.rasterize(*inputs, facing_camera())
    assert at_axis((color, opacity)) == (pytest.approx([MAX_ALPHA]), pytest.approx(MAX_ALPHA))
    gradients = torch.autograd.grad(color[12, 20].sum(), inputs)
    assert all((gradient == 0).all() for gradient in gradients[:3])
    assert gradients[3].item() == pytest.approx(MAX_ALPHA)


def test_what_would_exhaust_a_pixel_is_left_out_with_all_behind_it(reference):
    # Transmittances: .01, then 2e-4; the third would leave 2e-5; the fourth alone would leave 1.8e-4.
    gaussians = on_axis((4, 0.99), (5, 0.98), (6, 0.9), (7, 0.1))
    weights, opacity = at_axis(reference.rasterize(*gaussians, facing_camera()))
    assert weights == pytest.approx([0.99, 0.0098, 0, 0])
    assert opacity == pytest.approx(1 - 2e-4)
    # 1e-4 itself is too little, a bit more is not. The clamp makes the first alpha .999.
    for second, drawn in ((0.9 + 1e-12, False), (0.9 - 1e-9, True)):
        weights, _ = at_axis(reference.rasterize(*on_axis((4, 1.0), (5, second)), facing_camera()))
        assert (weights[1] > 0) == drawn


def test_what_is_too_near_or_too_faint_is_not_drawn(reference):
    weights, _ = at_axis(reference.rasterize(*on_axis((-4, 0.5), (0.0099, 0.5), (0.0101, 0.5)), facing_camera()))
    assert weights == pytest.approx([0, 0, 0.5])
    weights, _ = at_axis(reference.rasterize(*on_axis((4, 0.99 / 255), (5, 1.01 / 255)), facing_camera()))
    assert weights == pytest.approx([0, 1.01 / 255])


@pytest.mark.parametrize(("width", "height"), [(1, 1), (33, 17)])
def test_without_gaussians_the_background_shows(reference, width, height):
    camera = facing_camera(width, height)
    nothing = [torch.zeros(shape).requires_grad_() for shape in ((0, 3), (0, 3, 3), (0,), (0, 5))]
    behind = torch.rand((height, width, 5), generator=torch.Generator().manual_seed(0))
    color, opacity = reference.rasterize(*nothing, camera, background=behind)
    assert torch.equal(color, behind)
    assert torch.equal(opacity, torch.zeros((height, width)))
    color.sum().backward()
    assert nothing[3].grad.shape == (0, 5)


def test_the_dtype_is_that_of_the_gaussians(reference):
    for dtype in (torch.float32, torch.float64):
        images = reference.rasterize(*on_axis((4, 0.5), dtype=dtype), facing_camera(), depth=True)
        assert [image.dtype for image in images] == [dtype, dtype]


@pytest.mark.parametrize("seed", range(3))
def test_gradients_are_those_of_finite_differences(reference, seed):
    # The image is so small that most means lie beyond the margin at which the Jacobian is clamped.
    camera = turned_camera(9, 7)
    means, factors, opacities, colors = cloud(6, seed, channels=2, size=0.4, faintest=0.3)
    inputs = [
        means.requires_grad_(),
        factors.requires_grad_(),
        (0.9 * opacities).requires_grad_(),
        colors.requires_grad_(),
    ]
    behind = torch.rand((7, 9, 2), generator=torch.Generator().manual_seed(0)).double()
    smooth = ~reference.threshold_pixels(*inputs[:3], camera, 1e-4)
    assert smooth.double().mean() > 0.9

    def images(*gaussians):
        color, opacity = reference.rasterize(*gaussians, camera, background=behind, depth=True)
        return color[smooth], opacity[smooth]

    assert torch.autograd.gradcheck(images, inputs, eps=1e-6, atol=1e-6)


def flagged(reference, gaussians, camera=None, **options) -> list[tuple[int, int]]:
    pixels = reference.threshold_pixels(*gaussians[:3], camera or facing_camera(), **options)
    return [tuple(pixel) for pixel in pixels.nonzero().tolist()]


@pytest.mark.parametrize(
    ("gaussians", "doubtful"),
    [
        ([(4, 1.0005 / 255)], [(12, 20)]),  # alpha: just above 1/255
        ([(4, 0.9995 / 255)], [(12, 20)]),  # just below
        ([(4, 1.002 / 255)], []),
        ([(4, 0.998 / 255)], []),
        ([(4, 0.9985)], [(12, 20)]),  # just below the clamp
        ([(4, 0.99), (5, 0.98999)], [(12, 20)]),  # leaves just over 1e-4
        ([(4, 0.99), (5, 0.99001)], [(12, 20)]),  # would leave just under 1e-4
        ([(4, 0.99), (5, 0.95), (6, 0.9), (7, 0.9985)], []),  # no light reaches the one near the clamp
        ([(4, 0.5), (4.000001, 0.5)], "all that both reach"),
        ([(4, 0.5), (4.00001, 0.5)], []),
        ([(4, 0.5), (4, 0.5)], []),  # equal depths: the input decides
        ([(0.01, 0.5)], "all that it reaches"),
        ([(0.009999, 0.5)], "all that it reaches"),
    ],
    ids=str,
)
def test_threshold_pixels_are_where_rounding_may_decide(reference, gaussians, doubtful):
    # So small a Gaussian that its neighbors are far from the thresholds of the pixel on the axis.
    arrays = on_axis(*gaussians, deviation=1e-3)
    found = flagged(reference, arrays)
    if isinstance(doubtful, str):
        drawn = [(max(depth, 0.01), opacity) for depth, opacity in gaussians]
        reached = reference.rasterize(*on_axis(*drawn, deviation=1e-3), facing_camera())[1] > 0
        assert len(found) > 1
        assert set(found) == {tuple(pixel) for pixel in reached.nonzero().tolist()}
    else:
        assert found == doubtful


def test_threshold_pixels_are_all_that_a_gaussian_at_the_jacobians_limit_reaches(reference):
    limit = (40 + 0.15 * 40 - 20.5) / 50
    for slope, doubtful in ((limit * (1 + 1e-5), True), (limit * 1.02, False)):
        gaussians = list(on_axis((5, 0.5), deviation=0.7))
        gaussians[0] = torch.tensor([[5 * slope, 0, 5]]).double()
        reached = reference.rasterize(*gaussians, facing_camera())[1] > 0
        assert reached.sum() > 20
        found = reference.threshold_pixels(*gaussians[:3], facing_camera())
        assert torch.equal(found & reached, reached) == doubtful


def test_float32_agrees_away_from_threshold_pixels(reference):
    camera = turned_camera(160, 120)
    gaussians = [tensor.float() for tensor in cloud(1500, size=0.06)]
    color, opacity = reference.rasterize(*gaussians, camera)
    exact, exact_opacity = reference.rasterize(*[tensor.double() for tensor in gaussians], camera)
    smooth = ~reference.threshold_pixels(*gaussians[:3], camera)
    assert 0.9 < smooth[exact_opacity > 0].double().mean() < 1
    assert float((color - exact).abs()[smooth].max()) < 5e-5
    assert float((opacity - exact_opacity).abs()[smooth].max()) < 5e-5
