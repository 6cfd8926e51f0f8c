"""Gaussians to pixels: one differentiable function, with gsplat 1.5.3's conventions (constants.py).

`rasterize` takes and returns torch tensors and is differentiable; `rasterize_arrays` is the forward pass alone on numpy
arrays and needs no torch. On the CPU both give the same images bit for bit, on any number of threads.

What a fit can leave out, it does not pay for:
- `tile_modes` makes modes from masks of pixels: colour, opacity alone or nothing, tile by tile;
- `freeze` prepares Gaussians that never change, such as a fitted background: they are merged by depth with those that
  do, at no cost where these do not reach;
- `compact=True` gives tiles instead of images, to be compared with targets that `to_tiles` cut up beforehand.

`compositing_weights` gives the pixels that each Gaussian makes up, without a backward pass.

Opacity is of all that is rendered. For the liquid's visible opacity, before and behind a frozen background, give the
liquid a further channel of ones and the background one of zeros. That channel then holds it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from numpy.typing import ArrayLike, NDArray

from splashbench.render import arguments, counters, cpu
from splashbench.render.arguments import Floats
from splashbench.render.constants import TILE_HEIGHT, TILE_WIDTH
from splashbench.render.cpu import Frozen, compositing_weights, freeze
from splashbench.render.tiles import COLOR, OPACITY, SKIP, from_tiles, tile_grid, tile_modes, to_tiles
from splashbench.scene.camera import Camera

if TYPE_CHECKING:
    import torch

__all__ = [
    "COLOR", "OPACITY", "SKIP", "TILE_HEIGHT", "TILE_WIDTH", "Frozen", "compositing_weights", "counters", "freeze",
    "from_tiles", "rasterize", "rasterize_arrays", "tile_grid", "tile_modes", "to_tiles",
]  # fmt: skip

Cameras = Camera | Sequence[Camera]


def _views(cameras: Cameras, background: Any, modes: Any, frozen: Any, options: dict[str, Any]) -> list[dict[str, Any]]:
    """A camera's own keyword arguments, per camera."""
    options = {name: arguments.check_flag(value, name) for name, value in options.items()}
    if isinstance(cameras, Camera):
        if isinstance(frozen, list | tuple):
            raise TypeError("frozen is a list, for a single camera")
        return [{"camera": cameras, "background": background, "modes": modes, "frozen": frozen, **options}]
    if not isinstance(cameras, Sequence):
        arguments.check_camera(cameras)
    if not cameras:
        raise ValueError("cameras is empty")
    views: list[dict[str, Any]] = [{"camera": arguments.check_camera(camera), **options} for camera in cameras]
    for name, value in (("modes", modes), ("frozen", frozen), ("background", background)):
        per_camera = isinstance(value, list | tuple)
        if per_camera and len(value) != len(views):
            raise ValueError(f"{name} is for {len(value)} cameras, not {len(views)}")
        if isinstance(value, Frozen):
            raise ValueError("frozen is for one camera; give a list with one, or None, for each camera")
        for i, view in enumerate(views):
            view[name] = value[i] if per_camera else value
    return views


def rasterize_arrays(
    means: ArrayLike,
    factors: ArrayLike,
    opacities: ArrayLike,
    colors: ArrayLike | None,
    cameras: Cameras,
    *,
    background: Any = None,
    modes: Any = None,
    frozen: Any = None,
    depth: bool = False,
    compact: bool = False,
) -> Any:
    """Render N Gaussians on numpy arrays, on the CPU and without torch; arguments and results as `rasterize`."""
    views = _views(cameras, background, modes, frozen, {"depth": depth, "compact": compact})
    arrays = [arguments.floats(value, name) for value, name in zip((means, factors, opacities), arguments.GAUSSIANS)]
    channels = None if colors is None else arguments.floats(colors, "colors")
    per_camera = _per_camera(channels, cameras, len(views))
    images: tuple[list[Floats], list[Floats]] = ([], [])
    for i, view in enumerate(views):
        view_colors = channels[i] if channels is not None and per_camera else channels
        rendering = cpu.forward(arrays[0], arrays[1], arrays[2], view_colors, **view)
        images[0].append(rendering.color)
        images[1].append(rendering.opacity)
    return (images[0][0], images[1][0]) if isinstance(cameras, Camera) else images


def _per_camera(colors: Any, cameras: Cameras, count: int) -> bool:
    """Whether `colors` is [cameras, N, C]; ValueError where it is for another number of cameras."""
    if colors is None or colors.ndim != 3:
        return False
    if isinstance(cameras, Camera):
        raise ValueError(f"colors is {list(colors.shape)}, not [N, C], for a single camera")
    if len(colors) != count:
        raise ValueError(f"colors is for {len(colors)} cameras, not {count}")
    return True


def rasterize(
    means: torch.Tensor,
    factors: torch.Tensor,
    opacities: torch.Tensor,
    colors: torch.Tensor | None,
    cameras: Cameras,
    *,
    background: torch.Tensor | NDArray | Sequence | None = None,
    modes: NDArray | Sequence | None = None,
    frozen: Frozen | Sequence | None = None,
    depth: bool = False,
    compact: bool = False,
    backend: str = "auto",
) -> Any:
    """Render N Gaussians to (color [H, W, C], opacity [H, W]), float32; differentiable in the first four arguments.

    Args:
        means: [N, 3], scene units. factors: [N, 3, 3], B of the covariances B B^T, scene units (rotation times scales,
            for example). opacities: [N] in [0, 1]. colors: [N, C], 1 to 32 channels of any meaning; None for opacity
            alone.
        cameras: the view; its K may have any principal point, but no skew. With a sequence of cameras (whose sizes may
            differ) two lists come back, an image per camera; colors may then be [cameras, N, C], and background, modes
            and frozen lists with an entry per camera.
        background: [C] or [H, W, C], what shows through (black by default); gets no gradient.
        modes: uint8 [tile rows, tile columns], see `tile_modes`; all COLOR by default. Where a tile is not COLOR its
            color is the background, where it is SKIP its opacity is 0, and neither has a gradient.
        frozen: what `freeze` made for this camera of Gaussians that get no gradients. The images are those of all
            Gaussians together, bit for bit; at equal depth, the frozen ones come last.
        depth: append a channel to color: the sum of compositing weight times depth along the optical axis, scene
            units. Divided by opacity it is the mean depth. Its background is 0.
        compact: return tiles, [K, C, TILE_HEIGHT, TILE_WIDTH] and [K, TILE_HEIGHT, TILE_WIDTH], see `to_tiles`.
        backend: "cpu", "cuda" (gsplat, which the extra [cuda] installs), or "auto": that of the device of `means`,
            where it is there. A run's record names the backend that was used.

    Opacity is 1 minus the transmittance. Gaussians behind the near plane, fainter than one grey level or off the image
    are not drawn and get zero gradients; on the CPU, nor are those over a million pixels wide, beyond the digits of
    float32. On the CPU images and gradients repeat bit for bit.

    Raises:
        ValueError: an argument has the wrong shape, or holds a NaN or an infinity; TypeError: the wrong type. Both name
            the argument. SplashbenchError: there is no kernel, or no CUDA backend.
    """
    from splashbench.render.backends import backend_for

    for name, value in zip(arguments.GAUSSIANS, (means, factors, opacities, colors)):
        arguments.check_tensor(value, name, optional=name == "colors")
    views = _views(cameras, background, modes, frozen, {"depth": depth, "compact": compact})
    _per_camera(colors, cameras, len(views))
    outputs = backend_for(backend, means).rasterize(means, factors, opacities, colors, views)
    if isinstance(cameras, Camera):
        return outputs[0]
    return [color for color, _ in outputs], [opacity for _, opacity in outputs]
