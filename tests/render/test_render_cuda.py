"""The CUDA backend against the CPU's: images, gradients, modes, compact tiles, frozen Gaussians, bad input.

Each comparison runs twice. Once on gsplat and a CUDA device, where these are (marked cuda). And everywhere, on CPU
tensors, with a stand-in for gsplat: a module whose `rasterization` has the signature of 1.5.3, refuses what that
version refuses, and renders with the reference's formulas. That checks what is passed to gsplat and what is made of it.
"""

from __future__ import annotations

import gc
import inspect
import sys
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from importlib.machinery import ModuleSpec
from pathlib import Path
from subprocess import run
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch

from splashbench.errors import SplashbenchError
from splashbench.render import (
    COLOR,
    OPACITY,
    SKIP,
    counters,
    cuda,
    freeze,
    rasterize,
    tile_grid,
    to_tiles,
)
from splashbench.scene.camera import Camera

# The stand-in for gsplat


def _project(
    means: torch.Tensor, covars: torch.Tensor, w2c: torch.Tensor, K: torch.Tensor, size: tuple[int, int], blur: float
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Centers [N, 2], image covariances [N, 3] and depths [N], from the upper triangles of covars [N, 3, 3]."""
    i, j = [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]
    upper = covars[:, i, j]
    symmetric = upper[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)
    local = means @ w2c[:3, :3].T + w2c[:3, 3]
    z = local[:, 2]
    focal, middle, size_px = K.diagonal()[:2], K[:2, 2], torch.tensor(size, dtype=means.dtype)
    slopes = local[:, :2] / z[:, None]
    margin = 0.3 * 0.5 * size_px / focal
    clamped = slopes.clamp(-middle / focal - margin, (size_px - middle) / focal + margin)
    J = means.new_zeros((len(means), 2, 3))
    J[:, 0, 0], J[:, 1, 1] = focal[0] / z, focal[1] / z
    J[:, :, 2] = -focal * clamped / z[:, None]
    M = J @ w2c[:3, :3]
    projected = M @ symmetric @ M.transpose(1, 2)
    flat = torch.stack([projected[:, 0, 0] + blur, projected[:, 0, 1], projected[:, 1, 1] + blur], 1)
    return focal * slopes + middle, flat, z


class StandIn(ModuleType):
    """A module `gsplat`, version 1.5.3. `calls` holds the arguments of each call."""

    def __init__(self, reference: ModuleType) -> None:
        super().__init__("gsplat")
        self.__version__ = "1.5.3"
        self.reference = reference
        self.calls: list[dict[str, Any]] = []

    def rasterization(
        self,
        means: torch.Tensor,
        quats: torch.Tensor,
        scales: torch.Tensor,
        opacities: torch.Tensor,
        colors: torch.Tensor,
        viewmats: torch.Tensor,
        Ks: torch.Tensor,
        width: int,
        height: int,
        near_plane: float = 0.01,
        far_plane: float = 1e10,
        radius_clip: float = 0.0,
        eps2d: float = 0.3,
        sh_degree: int | None = None,
        packed: bool = True,
        tile_size: int = 16,
        backgrounds: torch.Tensor | None = None,
        render_mode: str = "RGB",
        sparse_grad: bool = False,
        absgrad: bool = False,
        rasterize_mode: str = "classic",
        channel_chunk: int = 32,
        distributed: bool = False,
        camera_model: str = "pinhole",
        segmented: bool = False,
        covars: torch.Tensor | None = None,
        with_ut: bool = False,
        with_eval3d: bool = False,
        radial_coeffs: torch.Tensor | None = None,
        tangential_coeffs: torch.Tensor | None = None,
        thin_prism_coeffs: torch.Tensor | None = None,
        ftheta_coeffs: Any = None,
        rolling_shutter: Any = None,
        viewmats_rs: torch.Tensor | None = None,
    ) -> tuple[torch.Tensor, torch.Tensor, dict]:
        self.calls.append({name: value for name, value in locals().items() if name != "self"})
        n, cameras = len(means), len(viewmats)
        assert n > 0, "gsplat's projection divides by the number of Gaussians: the process would be killed"
        assert means.shape == (n, 3)
        assert covars is not None
        assert covars.shape == (n, 3, 3)
        assert opacities.shape == (n,)
        assert viewmats.shape == (cameras, 4, 4)
        assert Ks.shape == (cameras, 3, 3)
        assert colors.shape[:-1] in ((n,), (cameras, n))
        assert 1 <= colors.shape[-1] <= 513
        assert backgrounds is None or backgrounds.shape == (cameras, colors.shape[-1])
        assert {t.dtype for t in (means, covars, opacities, colors, viewmats, Ks)} == {torch.float32}
        assert backgrounds is None or (backgrounds.dtype == torch.float32 and not backgrounds.requires_grad)
        assert render_mode in ("RGB", "D", "RGB+D")
        images, alphas = [], []
        for c in range(cameras):
            own = colors if colors.ndim == 2 else colors[c]
            behind = None if backgrounds is None else backgrounds[c].double()
            projected = _project(
                means.double(), covars.double(), viewmats[c].double(), Ks[c].double(), (width, height), eps2d
            )
            centers, image_covariances, depths = projected
            drawn = (depths >= near_plane) & (depths <= far_plane) & (opacities >= 1 / 255)
            ids = torch.nonzero(drawn)[:, 0]
            # gsplat sorts by the float32 depth, so that equal ones keep their order.
            ids = ids[torch.argsort(depths[ids].float(), stable=True)]
            features = {
                "RGB": own.double(),
                "D": depths[:, None],
                "RGB+D": torch.cat([own.double(), depths[:, None]], 1),
            }[render_mode]
            whole = self.reference.Tile(slice(0, height), slice(0, width), ids)
            _, alpha = self.reference.alphas_in(whole, centers[ids], image_covariances[ids], opacities[ids].double())
            sums, left = self.reference.blend(alpha, features[ids])
            if behind is not None and render_mode != "D":
                behind = torch.cat([behind, behind.new_zeros(sums.shape[1] - len(behind))])
                sums = sums + left[:, None] * behind
            images.append(sums.reshape(height, width, -1).float())
            alphas.append((1 - left).reshape(height, width, 1).float())
        return torch.stack(images), torch.stack(alphas), {}


def _install(monkeypatch: pytest.MonkeyPatch, module: ModuleType) -> None:
    """Make `import gsplat` give `module`, its kernels compiled, and let the CPU pass for a CUDA device."""
    monkeypatch.setitem(sys.modules, "gsplat", module)
    kernels = ModuleType("gsplat.csrc")
    kernels.__spec__ = ModuleSpec("gsplat.csrc", None)
    monkeypatch.setitem(sys.modules, "gsplat.csrc", kernels)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(cuda, "DEVICE", "cpu")


@dataclass
class Backend:
    """What the tests render with, and how near it comes to the CPU's images and gradients."""

    reference: ModuleType
    device: str
    image_tolerance: float  # largest difference
    gradient_tolerance: float  # relative L2
    calls: list[dict[str, Any]] = field(default_factory=list)

    def smooth(self, gaussians: list[torch.Tensor], camera: Camera) -> torch.Tensor:
        """bool [H, W], where rounding decides nothing; most of the image."""
        smooth = ~self.reference.threshold_pixels(*gaussians[:3], camera)
        assert smooth.float().mean() > 0.9
        return smooth


@pytest.fixture(autouse=True)
def _found_out_anew() -> Iterator[None]:
    cuda.available.cache_clear()
    yield
    cuda.available.cache_clear()


@pytest.fixture
def stand_in(reference: ModuleType, monkeypatch: pytest.MonkeyPatch) -> Backend:
    module = StandIn(reference)
    _install(monkeypatch, module)
    return Backend(reference, "cpu", 1e-5, 1e-4, module.calls)


def _real(reference: ModuleType) -> Backend:
    # gsplat compiles its kernels at first use; what that warns about is not this package's.
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        reason = cuda.available()
        if reason is not None:
            pytest.skip(reason)
        gaussians = _gaussians(0, 4)
        rasterize(*(t.cuda() for t in gaussians), VIEW, backend="cuda")
    # gsplat's backward pass starts from 1 - opacity: in a pixel with the least transmittance, 1e-4, float32 leaves
    # 6e-4 of doubt about that.
    return Backend(reference, "cuda", 1e-3, 1e-3)


@pytest.fixture(params=["stand-in", pytest.param("gsplat", marks=pytest.mark.cuda)])
def backend(request: pytest.FixtureRequest, reference: ModuleType) -> Backend:
    if request.param == "gsplat":
        return _real(reference)
    result: Backend = request.getfixturevalue("stand_in")
    return result


# Scenes


def _camera(name: str, width: int, height: int, turn: float = 0.0) -> Camera:
    """A camera 3 units before the origin, turned about the vertical axis; the principal point is off the center."""
    c, s = np.cos(turn), np.sin(turn)
    w2c = np.eye(4)
    w2c[:3, :3] = [[c, 0, s], [0, 1, 0], [-s, 0, c]]
    w2c[2, 3] = 3.0
    focal = 1.1 * width
    K = np.array([[focal, 0, width / 2 + 3.3], [0, 1.05 * focal, height / 2 - 2.1], [0, 0, 1.0]])
    return Camera(name, width, height, K, w2c)


VIEW = _camera("a", 140, 90)  # 3 x 3 tiles, those at the right and the bottom cut off by the image's edge
SIDE = _camera("b", 140, 90, turn=0.4)
SMALL = _camera("c", 70, 33, turn=-0.3)


def _gaussians(seed: int, count: int, channels: int = 3) -> list[torch.Tensor]:
    """Means, factors, opacities and colors: balls, discs and needles, some behind the camera or beyond the edges."""
    rng = np.random.default_rng(seed)
    means = rng.uniform([-1.6, -1.1, -1.0], [1.6, 1.1, 1.0], (count, 3))
    means[::9, 2] -= 3.5
    rotations = np.linalg.qr(rng.normal(size=(count, 3, 3)))[0]
    factors = rotations * np.exp(rng.uniform(np.log(0.01), np.log(0.3), (count, 1, 3)))
    opacities = rng.uniform(0.05, 1.0, count)
    opacities[:3] = 0.0, 1.0, 0.002
    arrays = means, factors, opacities, rng.uniform(size=(count, channels))
    return [torch.tensor(array, dtype=torch.float32) for array in arrays]


def _render(
    gaussians: list[torch.Tensor | None], cameras: Any, backend: str, device: str = "cpu", **options: Any
) -> tuple[Any, Any, list[torch.Tensor]]:
    """Color and opacity, on the CPU, and the leaves whose gradients to look at."""
    leaves = [None if t is None else t.clone().to(device).requires_grad_() for t in gaussians]
    color, opacity = rasterize(*leaves, cameras, backend=backend, **options)  # type: ignore[arg-type]
    if isinstance(cameras, Camera):
        color, opacity = color.cpu(), opacity.cpu()
    else:
        color, opacity = [image.cpu() for image in color], [image.cpu() for image in opacity]
    return color, opacity, [leaf for leaf in leaves if leaf is not None]


def _gradients(loss: torch.Tensor, leaves: list[torch.Tensor]) -> list[torch.Tensor]:
    loss.backward()
    gradients = []
    for leaf in leaves:
        assert leaf.grad is not None
        gradients.append(leaf.grad.cpu())
    return gradients


def _assert_same_image(ours: torch.Tensor, expected: torch.Tensor, smooth: torch.Tensor, tolerance: float) -> None:
    """Colors [H, W, C] or opacity [H, W] agree at smooth pixels; a channel beyond 1 (depth) relatively to its range."""
    assert (ours.shape, ours.dtype) == (expected.shape, expected.dtype)
    if ours.ndim == 3:
        ours, expected, smooth = ours.flatten(0, 1), expected.flatten(0, 1), smooth.reshape(-1, 1)
        tolerance = tolerance * expected.detach().abs().amax(0).clamp(min=1)
    assert (((ours - expected) * smooth).abs() <= tolerance).all()


def _assert_same_gradients(ours: list[torch.Tensor], expected: list[torch.Tensor], tolerance: float) -> None:
    for mine, theirs in zip(ours, expected, strict=True):
        assert theirs.norm() > 0
        assert (mine - theirs).norm() <= tolerance * theirs.norm()


def _assert_same(
    backend: Backend, gaussians: list[torch.Tensor | None], camera: Camera, smooth: torch.Tensor, **options: Any
) -> None:
    """Both backends give the same color, opacity and gradients at smooth pixels (in the layout of the output)."""
    color, opacity, leaves = _render(gaussians, camera, "cuda", backend.device, **options)
    expected_color, expected_opacity, expected_leaves = _render(gaussians, camera, "cpu", **options)
    over_channels = smooth[..., None]
    if options.get("compact"):
        assert color.shape == (len(smooth), color.shape[1], *smooth.shape[1:])
        over_channels = smooth[:, None]
        for ours, theirs, tile in zip(color, expected_color, smooth, strict=True):
            planes = ours.permute(1, 2, 0), theirs.permute(1, 2, 0)
            _assert_same_image(*planes, tile, backend.image_tolerance)
        for ours, theirs, tile in zip(opacity, expected_opacity, smooth, strict=True):
            _assert_same_image(ours, theirs, tile, backend.image_tolerance)
    else:
        _assert_same_image(color, expected_color, smooth, backend.image_tolerance)
        _assert_same_image(opacity, expected_opacity, smooth, backend.image_tolerance)
    generator = torch.Generator().manual_seed(1)
    weights = torch.randn(color.shape, generator=generator) * over_channels
    opacity_weights = torch.randn(opacity.shape, generator=generator) * smooth
    ours = _gradients((color * weights).sum() + (opacity * opacity_weights).sum(), leaves)
    theirs = _gradients((expected_color * weights).sum() + (expected_opacity * opacity_weights).sum(), expected_leaves)
    _assert_same_gradients(ours, theirs, backend.gradient_tolerance)


# Comparisons with the CPU backend


@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize("depth", [False, True])
@pytest.mark.parametrize("background", [None, "flat", "image"])
def test_images_and_gradients_are_those_of_the_cpu(
    backend: Backend, seed: int, depth: bool, background: str | None
) -> None:
    gaussians = _gaussians(seed, 60)
    shape = {None: None, "flat": (3,), "image": (VIEW.height, VIEW.width, 3)}[background]
    behind = None if shape is None else torch.rand(shape, generator=torch.Generator().manual_seed(seed))
    _assert_same(backend, gaussians, VIEW, backend.smooth(gaussians, VIEW), depth=depth, background=behind)


def test_a_crowded_scene(backend: Backend) -> None:
    """Opaque pixels, where compositing stops early."""
    gaussians = _gaussians(20, 600)
    gaussians[2] = gaussians[2].clamp(min=0.8)
    smooth = backend.smooth(gaussians, VIEW)
    _, opacity, _ = _render(gaussians, VIEW, "cpu")
    assert (opacity[smooth] > 0.999).sum() > 100
    _assert_same(backend, gaussians, VIEW, smooth, depth=True, background=torch.tensor([0.2, 0.4, 0.6]))


@pytest.mark.parametrize("channels", [1, 6, 32])
def test_depth_follows_any_number_of_channels(backend: Backend, channels: int) -> None:
    gaussians = _gaussians(3, 40, channels)
    _assert_same(backend, gaussians, VIEW, backend.smooth(gaussians, VIEW), depth=True, background=torch.ones(channels))


@pytest.mark.parametrize("depth", [False, True])
def test_opacity_alone(backend: Backend, depth: bool) -> None:
    gaussians = _gaussians(4, 40)
    _assert_same(backend, [*gaussians[:3], None], VIEW, backend.smooth(gaussians, VIEW), depth=depth)


def _modes() -> np.ndarray:
    return np.array([[COLOR, OPACITY, SKIP], [SKIP, COLOR, OPACITY], [OPACITY, SKIP, COLOR]], np.uint8)


@pytest.mark.parametrize("background", [None, "flat", "image"])
@pytest.mark.parametrize("compact", [False, True])
def test_tile_modes(backend: Backend, background: str | None, compact: bool) -> None:
    gaussians = _gaussians(5, 60)
    shape = {None: None, "flat": (3,), "image": (VIEW.height, VIEW.width, 3)}[background]
    behind = None if shape is None else torch.rand(shape, generator=torch.Generator().manual_seed(5))
    smooth = backend.smooth(gaussians, VIEW)
    if compact:
        smooth = torch.from_numpy(to_tiles(smooth.numpy(), _modes()))
    _assert_same(backend, gaussians, VIEW, smooth, modes=_modes(), compact=compact, depth=True, background=behind)


def test_tiles_without_color_cost_no_color_and_give_it_no_gradient(stand_in: Backend) -> None:
    gaussians = _gaussians(5, 60)
    modes = np.full(tile_grid(VIEW.width, VIEW.height), OPACITY, np.uint8)
    behind = torch.tensor([0.2, 0.4, 0.6])
    color, opacity, leaves = _render(gaussians, VIEW, "cuda", modes=modes, background=behind)
    _, expected, _ = _render(gaussians, VIEW, "cpu")
    assert torch.equal(color, behind.expand(VIEW.height, VIEW.width, 3))
    _assert_same_image(opacity, expected, stand_in.smooth(gaussians, VIEW), stand_in.image_tolerance)
    assert stand_in.calls[0]["colors"].shape == (60, 1)
    *others, of_colors = _gradients(opacity.sum(), leaves)
    assert all(gradient.abs().max() > 0 for gradient in others)
    assert torch.equal(of_colors, torch.zeros_like(of_colors))


def test_compact_output_of_all_tiles(backend: Backend) -> None:
    gaussians = _gaussians(6, 60)
    everywhere = np.full(tile_grid(VIEW.width, VIEW.height), COLOR, np.uint8)
    smooth = torch.from_numpy(to_tiles(backend.smooth(gaussians, VIEW).numpy(), everywhere))
    _assert_same(backend, gaussians, VIEW, smooth, compact=True, background=torch.tensor([0.2, 0.4, 0.6]))


@pytest.mark.parametrize("colored", [False, True])
def test_frozen_gaussians_are_rendered_and_get_no_gradients(backend: Backend, colored: bool) -> None:
    foreground, behind = _gaussians(7, 40), _gaussians(8, 40)
    behind[0][4], behind[2][4] = foreground[0][1], 0.9  # at the place of an opaque one, which comes first
    union = [torch.cat(pair) for pair in zip(foreground, behind)]
    smooth = backend.smooth(union, VIEW)
    if not colored:
        foreground, behind = [*foreground[:3], None], [*behind[:3], None]  # type: ignore[list-item]
    frozen = freeze(*behind, VIEW, depth=True)  # type: ignore[arg-type]
    _assert_same(backend, foreground, VIEW, smooth, frozen=frozen, depth=True)
    if backend.device == "cuda":
        joint, _ = rasterize(*(None if t is None else t.cuda() for t in [*union[:3], union[3] if colored else None]),
                             VIEW, depth=True, backend="cuda")  # fmt: skip
        alone, _ = rasterize(*(None if t is None else t.cuda() for t in foreground),
                             VIEW, frozen=frozen, depth=True, backend="cuda")  # fmt: skip
        assert torch.equal(joint, alone)


def test_frozen_gaussians_alone(backend: Backend) -> None:
    behind = _gaussians(8, 40)
    nothing = [tensor[:0] for tensor in behind]
    color, opacity, leaves = _render(nothing, VIEW, "cuda", backend.device, frozen=freeze(*behind, VIEW))
    expected, _, _ = _render(behind, VIEW, "cpu")
    _assert_same_image(color, expected, backend.smooth(behind, VIEW), backend.image_tolerance)
    assert [g.shape for g in _gradients(color.sum() + opacity.sum(), leaves)] == [t.shape for t in nothing]


def test_frozen_gaussians_move_to_the_device_once_and_leave_it_with_their_owner(stand_in: Backend) -> None:
    foreground = _gaussians(7, 10)
    frozen = freeze(*_gaussians(8, 10), VIEW)
    for _ in range(2):
        rasterize(*foreground, VIEW, frozen=frozen, backend="cuda")
    assert len(cuda._frozen_on_device) == 1
    del frozen
    gc.collect()
    assert not cuda._frozen_on_device


def test_several_cameras(backend: Backend) -> None:
    """One call of gsplat per size; images in the order of the cameras, each with its own colors and options."""
    gaussians = _gaussians(9, 40)
    cameras = [VIEW, SMALL, SIDE]
    colors = torch.rand((3, 40, 3), generator=torch.Generator().manual_seed(9))
    backgrounds = [torch.tensor([0.9, 0.5, 0.1]), None, torch.rand((90, 140, 3))]
    modes = [_modes(), None, None]
    inputs = [*gaussians[:3], colors]
    ours = _render(inputs, cameras, "cuda", backend.device, background=backgrounds, modes=modes, depth=True)
    theirs = _render(inputs, cameras, "cpu", background=backgrounds, modes=modes, depth=True)
    assert [call["viewmats"].shape for call in backend.calls] in ([], [(2, 4, 4), (1, 4, 4)])
    losses = []
    for color, opacity, leaves in (ours, theirs):
        total = torch.zeros(())
        for camera, image, alpha in zip(cameras, color, opacity):
            smooth = backend.smooth(gaussians, camera)
            weights = torch.randn(image.shape, generator=torch.Generator().manual_seed(1))
            total = total + (image * weights * smooth[..., None]).sum() + (alpha * smooth).sum()
        losses.append(_gradients(total, leaves))
    for mine, expected, camera in zip(ours[0], theirs[0], cameras):
        assert mine.shape == expected.shape
        smooth = backend.smooth(gaussians, camera)
        _assert_same_image(mine, expected, smooth, backend.image_tolerance)
    _assert_same_gradients(*losses, backend.gradient_tolerance)


def test_frozen_gaussians_of_several_cameras(backend: Backend) -> None:
    foreground, behind = _gaussians(14, 30), _gaussians(15, 30)
    union = [torch.cat(pair) for pair in zip(foreground, behind)]
    frozen = [freeze(*behind, VIEW), None]
    colors, _, _ = _render(foreground, [VIEW, SIDE], "cuda", backend.device, frozen=frozen)
    for color, camera, all_of_them in zip(colors, (VIEW, SIDE), (union, foreground)):
        expected, _, _ = _render(all_of_them, camera, "cpu")
        _assert_same_image(color, expected, backend.smooth(all_of_them, camera), backend.image_tolerance)


def test_no_cameras(stand_in: Backend) -> None:
    with pytest.raises(ValueError, match="cameras is empty"):
        rasterize(*_gaussians(0, 4), [], backend="cuda")


@pytest.mark.parametrize("compact", [False, True])
def test_nothing_to_draw(backend: Backend, compact: bool) -> None:
    """No Gaussians, or every tile skipped: the background, and gradients of 0."""
    gaussians = _gaussians(0, 10)
    behind = torch.tensor([0.2, 0.4, 0.6])
    skipped = np.full(tile_grid(VIEW.width, VIEW.height), SKIP, np.uint8)
    for inputs, modes in (([t[:0] for t in gaussians], None), (gaussians, skipped)):
        options: dict[str, Any] = {"background": behind, "modes": modes, "depth": True, "compact": compact}
        color, opacity, leaves = _render(inputs, VIEW, "cuda", backend.device, **options)
        expected_color, expected_opacity, _ = _render(inputs, VIEW, "cpu", **options)
        assert torch.equal(color, expected_color)
        assert torch.equal(opacity, expected_opacity)
        for gradient, tensor in zip(_gradients(color.sum() + opacity.sum(), leaves), inputs):
            assert torch.equal(gradient, torch.zeros_like(tensor))
    assert backend.calls == []


def test_gaussians_that_nobody_sees(backend: Backend) -> None:
    gaussians = _gaussians(0, 10)
    gaussians[0] = gaussians[0] + torch.tensor([0.0, 0.0, -10.0])
    color, opacity, leaves = _render(gaussians, VIEW, "cuda", backend.device, background=torch.ones(3))
    assert torch.equal(color, torch.ones_like(color))
    assert torch.equal(opacity, torch.zeros_like(opacity))
    assert all(gradient.abs().max() == 0 for gradient in _gradients(color.sum() + opacity.sum(), leaves))


def test_other_dtypes_and_layouts_are_converted(backend: Backend) -> None:
    plain = _gaussians(12, 30)
    expected, _, _ = _render(plain, VIEW, "cuda", backend.device)
    for convert in (
        lambda t: t.double(),
        lambda t: torch.stack([t, t], -1)[..., 0],
    ):
        color, opacity, leaves = _render([convert(t) for t in plain], VIEW, "cuda", backend.device)
        assert torch.equal(color, expected)
        assert (color.dtype, opacity.dtype) == (torch.float32, torch.float32)
        assert [g.dtype for g in _gradients(color.sum(), leaves)] == [leaf.dtype for leaf in leaves]


# Bad input


def _spoil(name: str, value: Callable[[torch.Tensor], Any]) -> dict[str, Any]:
    arguments = dict(zip(("means", "factors", "opacities", "colors"), _gaussians(0, 5)))
    arguments |= {"cameras": VIEW, "background": torch.rand(3), "modes": np.ones(tile_grid(140, 90), np.uint8)}
    return arguments | {name: value(arguments[name])}


def _with(entry: float) -> Callable[[torch.Tensor], torch.Tensor]:
    def changed(tensor: torch.Tensor) -> torch.Tensor:
        tensor = tensor.clone()
        tensor.view(len(tensor), -1)[3 if len(tensor) > 3 else 1, 0] = entry
        return tensor

    return changed


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *[(name, _with(bad)) for name in ("means", "factors", "opacities", "colors") for bad in (np.nan, -np.inf)],
        ("means", lambda t: t.double() * 1e200),
        ("means", lambda t: t[:, :2]),
        ("factors", lambda t: t[:4]),
        ("opacities", lambda t: t[:, None]),
        ("colors", lambda t: t.repeat(1, 11)),
        ("means", lambda t: t.long()),
        ("colors", lambda t: t.to(torch.complex64)),
        ("background", _with(np.nan)),
        ("background", lambda t: t[:2]),
        ("background", lambda t: t.long()),
        ("modes", lambda a: a[:2]),
        ("modes", lambda a: a + 2),
        ("cameras", lambda c: c.K),
    ],
)
def test_bad_input_is_refused_as_on_the_cpu(backend: Backend, name: str, value: Callable[[Any], Any]) -> None:
    arguments = _spoil(name, value)
    with pytest.raises((ValueError, TypeError)) as refused:
        rasterize(**arguments, backend="cpu")
    on_device = {n: v.to(backend.device) if isinstance(v, torch.Tensor) else v for n, v in arguments.items()}
    with pytest.raises(refused.type) as refused_here:
        rasterize(**on_device, backend="cuda")
    assert str(refused_here.value) == str(refused.value)
    assert name in str(refused.value)


def test_colors_for_another_number_of_cameras_are_refused(stand_in: Backend) -> None:
    gaussians = _gaussians(0, 5)
    colors = gaussians[3].expand(2, -1, -1)
    with pytest.raises(ValueError, match="colors is for 2 cameras, not 1"):
        cuda.rasterize(*gaussians[:3], colors, [{"camera": VIEW}])


def test_frozen_gaussians_of_another_camera_are_refused(backend: Backend) -> None:
    gaussians = [t.to(backend.device) for t in _gaussians(0, 5)]
    with pytest.raises(ValueError, match="frozen was made for another camera"):
        rasterize(*gaussians, SIDE, frozen=freeze(*_gaussians(1, 5), VIEW), backend="cuda")


# What gsplat is given


def test_what_gsplat_is_given(stand_in: Backend) -> None:
    gaussians = _gaussians(13, 20, channels=32)
    rasterize(*gaussians, [VIEW, SIDE], depth=True, background=torch.ones(32, requires_grad=True), backend="cuda")
    (call,) = stand_in.calls
    covariances = gaussians[1].double() @ gaussians[1].double().transpose(1, 2)
    assert torch.equal(call["covars"], call["covars"].transpose(1, 2))
    assert torch.allclose(call["covars"].double(), covariances, rtol=1e-5, atol=1e-7)
    assert (call["quats"], call["scales"]) == (None, None)
    assert torch.equal(call["viewmats"], torch.tensor(np.stack([VIEW.w2c, SIDE.w2c]), dtype=torch.float32))
    assert torch.equal(call["Ks"], torch.tensor(np.stack([VIEW.K, SIDE.K]), dtype=torch.float32))
    assert torch.equal(call["backgrounds"], torch.ones((2, 32)))
    numbers = {name: call[name] for name in ("width", "height", "near_plane", "radius_clip", "eps2d")}
    assert numbers == {"width": 140, "height": 90, "near_plane": 0.01, "radius_clip": 0.0, "eps2d": 0.3}
    assert (call["render_mode"], call["rasterize_mode"], call["camera_model"]) == ("RGB+D", "classic", "pinhole")
    assert call["channel_chunk"] >= 33
    assert call["far_plane"] > 1e30


def test_the_backend_is_counted(stand_in: Backend) -> None:
    counters.reset()
    rasterize(*_gaussians(0, 5), VIEW, frozen=freeze(*_gaussians(1, 7), VIEW), backend="cuda")
    assert (counters.calls(), counters.total()) == (1, 12)
    assert "cuda (gsplat 1.5.3)" in counters.backends()


@pytest.mark.cuda
def test_the_stand_in_has_gsplats_signature(reference: ModuleType) -> None:
    _real(reference)
    import gsplat

    ours = inspect.signature(StandIn(reference).rasterization).parameters
    theirs = inspect.signature(gsplat.rasterization).parameters
    assert list(ours) == list(theirs)
    different = {name for name in ours if ours[name].default != theirs[name].default}
    assert different == {"rolling_shutter"}  # a value of gsplat's own enumeration there


@pytest.mark.cuda
def test_tensors_on_the_device_are_rendered_there_and_stay_there(reference: ModuleType) -> None:
    _real(reference)
    color, opacity = rasterize(*(t.cuda() for t in _gaussians(0, 20)), VIEW)
    assert (color.is_cuda, opacity.is_cuda) == (True, True)
    color, opacity = rasterize(*_gaussians(0, 20), VIEW, backend="cuda")
    assert (color.is_cuda, opacity.is_cuda) == (False, False)


# Where it is not available


def test_importing_it_needs_no_gsplat_and_no_device() -> None:
    code = "import sys; import splashbench.render.cuda; print([m for m in sys.modules if m.startswith('gsplat')])"
    result = run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout == "[]\n"


@pytest.mark.parametrize(
    ("spoil", "reason"),
    [
        (lambda m: m.setattr(torch.cuda, "is_available", lambda: False), "PyTorch sees no CUDA device; use backend="),
        (lambda m: m.setitem(sys.modules, "gsplat", None), r"pip install 'splashbench\[cuda\]'"),
        (
            lambda m: m.setattr(sys.modules["gsplat"], "__version__", "1.6.0"),
            "version 1.6.0.*; pip install gsplat==1.5.3",
        ),
    ],
)
def test_it_says_why_it_is_not_available(
    stand_in: Backend, monkeypatch: pytest.MonkeyPatch, spoil: Callable[[pytest.MonkeyPatch], None], reason: str
) -> None:
    spoil(monkeypatch)
    with pytest.raises(SplashbenchError, match=reason) as refused:
        rasterize(*_gaussians(0, 5), VIEW, backend="cuda")
    assert "\n" not in str(refused.value)
    with pytest.raises(SplashbenchError, match=reason):
        cuda.rasterize(*_gaussians(0, 5), [{"camera": VIEW}])


def test_kernels_that_cannot_be_compiled(stand_in: Backend, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delitem(sys.modules, "gsplat.csrc")
    sys.modules["gsplat"].__path__ = []  # a package without the compiled module
    for name in ("PATH", "CUDA_HOME"):
        monkeypatch.setenv(name, str(tmp_path))
    reason = cuda.available()
    assert reason is not None
    assert "install the CUDA toolkit" in reason
    (tmp_path / "bin").mkdir()
    (tmp_path / "bin" / "nvcc").touch()
    cuda.available.cache_clear()
    assert cuda.available() is None


def test_a_local_version_of_gsplat_will_do(stand_in: Backend, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys.modules["gsplat"], "__version__", "1.5.3+pt24cu124")
    assert cuda.available() is None
