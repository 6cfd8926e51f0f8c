"""Rendering no more than is needed: modes per tile, compact tiles, frozen Gaussians, several cameras in one call."""

from __future__ import annotations

import gc

import numpy as np
import pytest
import torch

from splashbench.render import (
    COLOR,
    OPACITY,
    SKIP,
    TILE_HEIGHT,
    TILE_WIDTH,
    freeze,
    from_tiles,
    native,
    rasterize,
    rasterize_arrays,
    tile_modes,
    to_tiles,
)
from splashbench.scene.camera import Camera


def camera_at(x: float = 0.0, width: int = 200, height: int = 110) -> Camera:
    w2c = np.eye(4)
    w2c[0, 3] = x
    return Camera(f"at {x}", width, height, np.array([[160.0, 0, 97], [0, 160.0, 52], [0, 0, 1]]), w2c)


def scatter(n: int = 600, seed: int = 0, channels: int = 3, depth: float = 4.0) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    arrays = (
        rng.normal(size=(n, 3)) * [1.2, 0.6, 0.6] + [0, 0, depth],
        rng.normal(size=(n, 3, 3)) * 0.06,
        rng.uniform(0.1, 1, n),
        rng.uniform(size=(n, channels)),
    )
    return [a.astype(np.float32) for a in arrays]


def leaves(arrays: list[np.ndarray]) -> list[torch.Tensor]:
    return [torch.tensor(a, requires_grad=True) for a in arrays]


def expand(modes: np.ndarray, camera: Camera) -> np.ndarray:
    """Modes per pixel."""
    return np.kron(modes, np.ones((TILE_HEIGHT, TILE_WIDTH), np.uint8))[: camera.height, : camera.width]


def test_modes_cover_the_masks_of_pixels():
    color, opacity = np.zeros((110, 200), bool), np.zeros((110, 200), bool)
    color[31, 63] = color[109, 199] = True
    opacity[:32] = True
    modes = tile_modes(color, opacity)
    expected = np.full((4, 4), SKIP)
    expected[0] = OPACITY
    expected[0, 0] = expected[3, 3] = COLOR
    np.testing.assert_array_equal(modes, expected)
    assert modes.dtype == np.uint8
    with pytest.raises(TypeError, match=r"bool \[H, W\]"):
        tile_modes(color.astype(float))
    with pytest.raises(ValueError, match="opacity is"):
        tile_modes(color, opacity[1:])


@pytest.mark.parametrize("channels", [1, 3, 6])
def test_each_tile_holds_what_its_mode_says_and_nothing_else_changes(channels):
    camera, arrays = camera_at(), scatter(channels=channels)
    modes = np.random.default_rng(3).integers(0, 3, (4, 4)).astype(np.uint8)
    assert set(modes.ravel()) == {SKIP, OPACITY, COLOR}
    background = np.linspace(0.1, 0.4, channels).astype(np.float32)
    whole, whole_opacity = rasterize_arrays(*arrays, camera, background=background)
    color, opacity = rasterize_arrays(*arrays, camera, background=background, modes=modes)
    pixels = expand(modes, camera)
    np.testing.assert_array_equal(color[pixels == COLOR], whole[pixels == COLOR])
    np.testing.assert_array_equal(opacity[pixels != SKIP], whole_opacity[pixels != SKIP])
    assert (color[pixels != COLOR] == background).all()
    assert (opacity[pixels == SKIP] == 0).all()


def test_gradients_of_modes_are_those_of_a_masked_loss():
    camera, arrays = camera_at(), scatter()
    modes = np.random.default_rng(3).integers(0, 3, (4, 4)).astype(np.uint8)
    pixels = torch.as_tensor(expand(modes, camera))
    rng = np.random.default_rng(5)
    color_weights = torch.as_tensor(rng.normal(size=(110, 200, 3)).astype(np.float32))
    opacity_weights = torch.as_tensor(rng.normal(size=(110, 200)).astype(np.float32))
    masked, plain = leaves(arrays), leaves(arrays)
    color, opacity = rasterize(*masked, camera, modes=modes)
    ((color * color_weights).sum() + (opacity * opacity_weights).sum()).backward()
    color, opacity = rasterize(*plain, camera)
    color = color * (pixels == COLOR)[..., None]
    opacity = opacity * (pixels != SKIP)
    ((color * color_weights).sum() + (opacity * opacity_weights).sum()).backward()
    for got, expected in zip(masked, plain):
        assert expected.grad.abs().max() > 0
        torch.testing.assert_close(got.grad, expected.grad, rtol=1e-5, atol=1e-5 * float(expected.grad.abs().max()))


@pytest.mark.parametrize("shape", [(110, 200), (110, 200, 1), (110, 200, 5)])
def test_images_survive_being_cut_into_tiles(shape):
    image = np.random.default_rng(0).random(shape)
    modes = np.ones((4, 4), np.uint8)
    np.testing.assert_array_equal(from_tiles(to_tiles(image, modes), modes, 110, 200), image)
    modes[1, 2] = modes[3, 3] = SKIP
    tiles = to_tiles(image, modes)
    assert tiles.shape == (14, *shape[2:], TILE_HEIGHT, TILE_WIDTH)
    kept = expand(modes, camera_at()) != SKIP
    back = from_tiles(tiles, modes, 110, 200)
    np.testing.assert_array_equal(back[kept], image[kept])
    assert (back[~kept] == 0).all()
    with pytest.raises(ValueError, match="do not make an image"):
        from_tiles(tiles[1:], modes, 110, 200)
    with pytest.raises(ValueError, match=r"modes are \[4, 3\]"):
        to_tiles(image, modes[:, 1:])
    with pytest.raises(ValueError, match=r"tiles is \[14, 1, 1\]"):
        from_tiles(np.zeros((14, 1, 1)), modes, 110, 200)
    with pytest.raises(ValueError, match=r"image is \[5\]"):
        to_tiles(np.zeros(5), modes)


@pytest.mark.parametrize("channels", [3, 5])
@pytest.mark.parametrize("background", ["none", "flat", "image"])
@pytest.mark.parametrize("masked", [True, False])
def test_compact_output_holds_the_same_pixels_and_gradients(channels, background, masked):
    camera, arrays = camera_at(), scatter(channels=channels)
    modes = np.random.default_rng(3).integers(0, 3, (4, 4)).astype(np.uint8) if masked else None
    everywhere = np.ones((4, 4), np.uint8) if modes is None else modes
    rng = np.random.default_rng(2)
    behind = {
        "none": None,
        "flat": rng.random(channels).astype(np.float32),
        "image": rng.random((110, 200, channels)).astype(np.float32),
    }[background]
    plain, tiled = leaves(arrays), leaves(arrays)
    color, opacity = rasterize(*plain, camera, background=behind, modes=modes)
    tiles, opacity_tiles = rasterize(*tiled, camera, background=behind, modes=modes, compact=True)
    kept = expand(everywhere, camera) != SKIP
    np.testing.assert_array_equal(
        from_tiles(tiles.detach().numpy(), everywhere, 110, 200)[kept], color.detach().numpy()[kept]
    )
    np.testing.assert_array_equal(
        from_tiles(opacity_tiles.detach().numpy(), everywhere, 110, 200), opacity.detach().numpy()
    )
    color_weights, opacity_weights = rng.normal(size=(110, 200, channels)), rng.normal(size=(110, 200))
    ((color * torch.as_tensor(color_weights)).sum() + (opacity * torch.as_tensor(opacity_weights)).sum()).backward()
    loss = (tiles * torch.as_tensor(to_tiles(color_weights, everywhere))).sum()
    (loss + (opacity_tiles * torch.as_tensor(to_tiles(opacity_weights, everywhere))).sum()).backward()
    for got, expected in zip(tiled, plain):
        torch.testing.assert_close(got.grad, expected.grad, rtol=0, atol=0)


@pytest.mark.parametrize("channels", [1, 3, 4])
@pytest.mark.parametrize("depth", [False, True])
@pytest.mark.parametrize("masked", [False, True])
def test_frozen_gaussians_give_the_union_bit_for_bit(channels, depth, masked):
    camera = camera_at()
    liquid = scatter(300, seed=1, channels=channels)
    liquid[0][:, 0] = np.abs(liquid[0][:, 0]) * 0.4  # in a part of the image only
    # Interleaved in depth, and a few at depths of the liquid's own.
    behind = scatter(500, seed=2, channels=channels)
    behind[0][:20, 2] = liquid[0][:20, 2]
    modes = np.random.default_rng(3).integers(0, 3, (4, 4)).astype(np.uint8) if masked else None
    options = {"background": np.linspace(0.2, 0.6, channels), "modes": modes, "depth": depth}
    union = [np.concatenate(pair) for pair in zip(liquid, behind)]
    joint, apart = leaves(union), leaves(liquid)
    expected = rasterize(*joint, camera, **options)
    got = rasterize(*apart, camera, frozen=freeze(*behind, camera, depth=depth), **options)
    for image, wanted in zip(got, expected):
        assert torch.equal(image, wanted)
    weights = [torch.randn(image.shape, generator=torch.Generator().manual_seed(i)) for i, image in enumerate(got)]
    for images in (got, expected):
        sum((image * weight).sum() for image, weight in zip(images, weights)).backward()
    for tensor, whole in zip(apart, joint):
        assert tensor.grad.abs().max() > 0
        wanted = whole.grad[: len(tensor)]
        torch.testing.assert_close(tensor.grad, wanted, rtol=1e-5, atol=2e-6 * float(wanted.abs().max()))


def test_the_visible_opacity_of_the_liquid_is_a_channel_of_ones():
    camera = camera_at()
    liquid, wall = scatter(200, seed=1, channels=4), scatter(200, seed=2, channels=4)
    liquid[3][:, 3], wall[3][:, 3] = 1, 0
    color, opacity = rasterize_arrays(*liquid, camera, frozen=freeze(*wall, camera))
    alone = rasterize_arrays(*liquid, camera)[1]
    assert (color[..., 3] <= np.minimum(alone, opacity) + 1e-5).all()
    assert color[..., 3].max() > 0.5
    wall[0][:, 2] += 10  # now all of it lies behind
    color, _ = rasterize_arrays(*liquid, camera, frozen=freeze(*wall, camera))
    np.testing.assert_allclose(color[..., 3], alone, atol=1e-5)


def test_freezing_nothing_and_rendering_nothing_over_it():
    camera = camera_at()
    arrays = scatter(100)
    none = [a[:0] for a in arrays]
    expected = rasterize_arrays(*arrays, camera)
    for got in (
        rasterize_arrays(*arrays, camera, frozen=freeze(*none, camera)),
        rasterize_arrays(*none, camera, frozen=freeze(*arrays, camera)),
    ):
        np.testing.assert_array_equal(got[0], expected[0])
        np.testing.assert_array_equal(got[1], expected[1])


def test_frozen_gaussians_are_what_they_were_and_serve_one_camera():
    camera, arrays = camera_at(), scatter(100)
    frozen = freeze(*arrays, camera)
    expected = rasterize_arrays(*arrays, camera)
    none = [a[:0] for a in arrays]
    for a in arrays:
        a[:] = 0
    np.testing.assert_array_equal(rasterize_arrays(*none, camera, frozen=frozen)[0], expected[0])
    assert len(frozen) == 100
    assert frozen.bytes > 100 * 64
    with pytest.raises(ValueError, match=r"another camera than at 0\.5"):
        rasterize_arrays(*none, camera_at(0.5), frozen=frozen)
    with pytest.raises(ValueError, match="frozen has 3 channels"):
        rasterize_arrays(*none[:3], None, camera, frozen=frozen)
    with pytest.raises(ValueError, match=r"depth False\), colors 3 \(depth True"):
        rasterize_arrays(*none, camera, frozen=frozen, depth=True)
    with pytest.raises(ValueError, match="opacities is not finite in 1 of 100 rows"):
        freeze(*arrays[:2], np.where(np.arange(100) == 3, np.nan, 0.5), arrays[3], camera)


@pytest.mark.parametrize("own_colors", [False, True])
def test_several_cameras_in_one_call_equal_one_call_each(own_colors):
    cameras = [camera_at(), camera_at(0.4, 90, 70), camera_at(-0.4)]
    arrays = scatter()
    if own_colors:
        arrays[3] = np.random.default_rng(0).random((3, 600, 3)).astype(np.float32)
    behind = scatter(50, seed=9)
    options = [
        {"background": np.array([0.1, 0.2, 0.3]), "modes": None, "frozen": freeze(*behind, cameras[0])},
        {"background": None, "modes": tile_modes(np.ones((70, 90), bool)), "frozen": None},
        {"background": None, "modes": np.full((4, 4), OPACITY, np.uint8), "frozen": None},
    ]
    together, apart = leaves(arrays), leaves(arrays)
    colors, opacities = rasterize(*together, cameras, **{key: [o[key] for o in options] for key in options[0]})
    assert [c.shape for c in colors] == [(110, 200, 3), (70, 90, 3), (110, 200, 3)]
    plain = rasterize_arrays(*arrays, cameras, **{key: [o[key] for o in options] for key in options[0]})
    losses = []
    for i, (camera, own) in enumerate(zip(cameras, options)):
        color, opacity = rasterize(*apart[:3], apart[3][i] if own_colors else apart[3], camera, **own)
        assert torch.equal(colors[i], color)
        assert torch.equal(opacities[i], opacity)
        np.testing.assert_array_equal(plain[0][i], color.detach().numpy())
        losses.append(color.square().sum() + opacity.sum())
    sum(losses).backward()
    sum(color.square().sum() + opacity.sum() for color, opacity in zip(colors, opacities)).backward()
    for got, expected in zip(together, apart):
        torch.testing.assert_close(got.grad, expected.grad, rtol=1e-5, atol=1e-5 * float(expected.grad.abs().max()))


def test_lists_of_the_wrong_length_are_refused():
    cameras, arrays = [camera_at(), camera_at(0.1)], scatter(20)
    with pytest.raises(ValueError, match="modes is for 1 cameras, not 2"):
        rasterize_arrays(*arrays, cameras, modes=[None])
    with pytest.raises(ValueError, match="frozen is for one camera"):
        rasterize_arrays(*arrays, cameras, frozen=freeze(*arrays, cameras[0]))
    with pytest.raises(ValueError, match="colors is for 3 cameras, not 2"):
        rasterize_arrays(*arrays[:3], np.zeros((3, 20, 3)), cameras)


def test_memory_is_used_again_and_does_not_grow():
    process = pytest.importorskip("psutil").Process()
    camera = camera_at(width=1000, height=800)
    tensors = leaves(scatter(30000))

    def step() -> None:
        color, opacity = rasterize(*tensors, camera)
        (color.sum() + opacity.sum()).backward()

    for _ in range(5):
        step()
    gc.collect()
    before = process.memory_info().rss
    for _ in range(30):
        step()
    gc.collect()
    assert process.memory_info().rss - before < 40e6
    native.KERNEL.library.splash_trim()
