"""The CUDA backend: `gsplat.rasterization` of gsplat 1.5.3 with the arguments and results of the CPU's (autograd.py).

Cameras of one size are rendered in one call. gsplat's function takes no tile masks. Its lower level does
(`rasterize_to_pixels`), but leaves the opacity of masked tiles unset. So modes are applied to the finished images here:
results and gradients are the CPU's, and a skipped tile saves no time. Frozen Gaussians are rendered again in each call.

The image repeats bit for bit. Gradients do not, since gsplat sums them by atomic additions. Its exponentials are the
device's fast ones, and it takes transmittances back from opacities, so gradients in nearly opaque pixels are rougher.
The largest alpha (0.999), the smallest (1/255), the least transmittance (1e-4) and the margin of the Jacobian (0.15 of
the image's size) are compiled into gsplat. In 1.5.3 they are those of constants.py; 1.6 has another largest alpha.
"""

from __future__ import annotations

import importlib
import importlib.util
import math
import os
import shutil
import weakref
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from splashbench.errors import SplashbenchError, one_line
from splashbench.render import arguments, counters
from splashbench.render.constants import BLUR_VARIANCE, NEAR_PLANE, TILE_HEIGHT, TILE_WIDTH
from splashbench.render.cpu import Frozen
from splashbench.render.native import MAX_CHANNELS
from splashbench.render.tiles import COLOR, SKIP, Modes, tile_grid
from splashbench.scene.camera import Camera

GSPLAT_VERSION = "1.5.3"
DEVICE = "cuda"
"""Where tensors go that are not on a CUDA device yet."""


class DeviceGaussians(NamedTuple):
    """float32 on the device. colors: [N, C], or [cameras, N, C], or None for opacity alone."""

    means: Tensor
    factors: Tensor
    opacities: Tensor
    colors: Tensor | None


class CameraArguments(NamedTuple):
    """One camera's rendering, its arguments checked."""

    camera: Camera
    background: Tensor | None  # float32 [C] or [H, W, C], on the device
    modes: Modes | None
    frozen: Frozen | None
    depth: bool
    compact: bool

    @property
    def size(self) -> tuple[int, int]:
        """Height and width, px."""
        return self.camera.height, self.camera.width

    def holds(self, least: int) -> bool:
        """Whether a tile's mode is `least` or more: OPACITY or COLOR."""
        return self.modes is None or bool((self.modes >= least).any())


@lru_cache(maxsize=1)
def available() -> str | None:
    """None where this backend can render, else one line with the reason and the remedy. Found out once per process."""
    if not torch.cuda.is_available():
        return "PyTorch sees no CUDA device; use backend='cpu', or an NVIDIA GPU and a PyTorch built for CUDA"
    try:
        gsplat = importlib.import_module("gsplat")
    except (ImportError, OSError, RuntimeError) as error:
        return one_line(
            f"gsplat cannot be imported ({error}); in a checkout: pip install -c constraints.txt -e '.[cuda]'"
        )
    # Wheels with compiled kernels add the versions of PyTorch and CUDA after a plus sign.
    version = str(getattr(gsplat, "__version__", "unknown"))
    if version.split("+")[0] != GSPLAT_VERSION:
        return f"gsplat is version {version}, which renders differently; pip install gsplat=={GSPLAT_VERSION}"
    if importlib.util.find_spec("gsplat.csrc") is None and not _toolkit_found():
        return "gsplat compiles its kernels at first use, and there is no nvcc; install the CUDA toolkit, set CUDA_HOME"
    return None


def _toolkit_found() -> bool:
    """Whether there is an nvcc, looked for where PyTorch's extension builder does."""
    home = os.environ.get("CUDA_HOME") or os.environ.get("CUDA_PATH") or "/usr/local/cuda"
    return shutil.which("nvcc") is not None or Path(home, "bin", "nvcc").is_file()


def _gsplat() -> ModuleType:
    reason = available()
    if reason is not None:
        raise SplashbenchError(f"the renderer's CUDA backend cannot be used: {reason}")
    return importlib.import_module("gsplat")


def rasterize(
    means: Tensor, factors: Tensor, opacities: Tensor, colors: Tensor | None, views: Sequence[dict[str, Any]]
) -> list[tuple[Tensor, Tensor]]:
    """(color, opacity) of each view, on the device of `means`; see `splashbench.render.rasterize`.

    Args:
        means, factors, opacities, colors: floating point tensors on any device. colors may be [views, N, C].
        views: per camera the keyword arguments camera, background, modes, frozen, depth and compact.

    Raises:
        ValueError, TypeError: as on the CPU. SplashbenchError: there is no CUDA device or no gsplat 1.5.3.
    """
    gsplat = _gsplat()
    device = means.device if means.is_cuda else torch.device(DEVICE)
    per_view = colors is not None and colors.ndim == 3
    if colors is not None and per_view and len(colors) != len(views):
        raise ValueError(f"colors is for {len(colors)} cameras, not {len(views)}")
    requests = []
    for i, options in enumerate(views):
        view_colors = colors[i] if colors is not None and per_view else colors
        requests.append(_check_view(means, factors, opacities, view_colors, options, device))
    inputs = DeviceGaussians(
        means.to(device, torch.float32),
        factors.to(device, torch.float32),
        opacities.to(device, torch.float32),
        None if colors is None else colors.to(device, torch.float32),
    )
    _check_finite(inputs)
    # 0, computed from all inputs: one that an image does not depend on gets a gradient of 0, as on the CPU, not None.
    anchor = torch.stack([tensor[:0].sum() for tensor in inputs if tensor is not None]).sum()
    inputs = inputs._replace(opacities=inputs.opacities + anchor)

    results: dict[int, tuple[Tensor, Tensor]] = {}
    for batch in _batches(requests):
        members = [requests[i] for i in batch]
        gaussians = inputs._replace(colors=inputs.colors[batch]) if inputs.colors is not None and per_view else inputs
        images = _render(gsplat, _with_frozen(gaussians, members[0].frozen, device), members, device)
        for i, view, (color, opacity) in zip(batch, members, images):
            color, opacity = (image if image.requires_grad else image + anchor for image in (color, opacity))
            if view.compact:
                color = _tiles(color, view)
                opacity = _tiles(opacity[..., None], view)[:, 0]
            results[i] = color.to(means.device), opacity.to(means.device)
            frozen = 0 if view.frozen is None else len(view.frozen)
            counters.record(len(means) + frozen, f"cuda (gsplat {GSPLAT_VERSION})")
    return [results[i] for i in range(len(requests))]


def _check_view(
    means: Tensor,
    factors: Tensor,
    opacities: Tensor,
    colors: Tensor | None,
    options: dict[str, Any],
    device: torch.device,
) -> CameraArguments:
    camera, frozen = arguments.check_camera(options["camera"]), options.get("frozen")
    depth, compact = bool(options.get("depth")), bool(options.get("compact"))
    channels = arguments.check_shapes(means, factors, opacities, colors)
    arguments.check_frozen(frozen, camera, channels, depth)
    background = _background(options.get("background"), camera, channels, device)
    modes = options.get("modes")
    modes = arguments.check_modes(modes.cpu() if isinstance(modes, Tensor) else modes, camera)
    return CameraArguments(camera, background, modes, frozen, depth, compact)


def _background(background: Any, camera: Camera, channels: int, device: torch.device) -> Tensor | None:
    """The background on the device, without a gradient. One that is there already stays there."""
    if background is None:
        return None
    shapes = ((channels,), (camera.height, camera.width, channels))
    there = isinstance(background, Tensor) and background.device.type == device.type
    if there and background.is_floating_point() and tuple(background.shape) in shapes:
        tensor = background.detach().to(device, torch.float32)
        if bool(torch.isfinite(tensor).all()):
            return tensor
    return torch.tensor(arguments.check_background(background, camera, channels), device=device)


def _check_finite(gaussians: DeviceGaussians) -> None:
    """Raise ValueError as on the CPU where an entry is not finite; waits for the device once."""
    finite = torch.stack([torch.isfinite(tensor).all() for tensor in gaussians if tensor is not None])
    if bool(finite.all()):
        return
    means, factors, opacities = (tensor.detach().cpu().numpy() for tensor in gaussians[:3])
    colors = None if gaussians.colors is None else gaussians.colors.detach().cpu().numpy()
    for view_colors in colors if colors is not None and colors.ndim == 3 else [colors]:
        arguments.check_finite(means, factors, opacities, view_colors)


def _batches(views: Sequence[CameraArguments]) -> list[list[int]]:
    """The views' indices, together where one call of gsplat can render them: same size, same Gaussians."""
    batches: dict[tuple, list[int]] = {}
    for i, view in enumerate(views):
        batches.setdefault((view.size, id(view.frozen), view.depth), []).append(i)
    return list(batches.values())


_frozen_on_device: dict[tuple[int, torch.device], DeviceGaussians] = {}


def _with_frozen(gaussians: DeviceGaussians, frozen: Frozen | None, device: torch.device) -> DeviceGaussians:
    """The Gaussians, then the frozen ones: gsplat's sort is stable, so this is the order at equal depth."""
    if frozen is None:
        return gaussians
    key = (id(frozen), device)
    if key not in _frozen_on_device:
        means, factors, opacities = (torch.tensor(array, device=device) for array in frozen.gaussians[:3])
        channels = frozen.gaussians[3]
        colors = None if channels is None else torch.tensor(channels, device=device)
        _frozen_on_device[key] = DeviceGaussians(means, factors, opacities, colors)
        weakref.finalize(frozen, _frozen_on_device.pop, key, None)
    behind = _frozen_on_device[key]
    means, factors, opacities = (torch.cat(pair) for pair in zip(gaussians[:3], behind[:3]))
    colors = gaussians.colors
    if colors is not None and behind.colors is not None:
        colors = torch.cat([colors, behind.colors.expand(*colors.shape[:-2], -1, -1)], dim=-2)
    return DeviceGaussians(means, factors, opacities, colors)


def _render(
    gsplat: ModuleType, gaussians: DeviceGaussians, views: Sequence[CameraArguments], device: torch.device
) -> list[tuple[Tensor, Tensor]]:
    """Images (color [H, W, C or C + 1], opacity [H, W]) of views of one size and one set of Gaussians."""
    means, factors, opacities, colors = gaussians
    (height, width), depth = views[0].size, views[0].depth
    channels = 0 if colors is None else colors.shape[-1]
    # gsplat divides by the number of Gaussians on the host, so it must never see none.
    drawn = len(means) > 0 and any(view.holds(SKIP + 1) for view in views)
    colored = drawn and (channels > 0 or depth) and any(view.holds(COLOR) for view in views)
    images: Tensor | None = None
    alphas: Tensor | None = None
    if drawn:
        mode = "RGB"
        if colored and depth:
            mode = "RGB+D" if channels else "D"
        features = colors
        if colors is None or not colored:  # gsplat takes no fewer than one channel
            features = means.new_zeros((len(means), 1))
        # gsplat reads the upper triangle of covars alone, and returns the gradient there: twice the symmetric one off
        # the diagonal, zero below it. Added to its transpose, as the product rule does here, that is the full gradient
        # by B. Not a matrix product: a caller may have allowed TF32 for those.
        covariances = (factors[:, :, None] * factors[:, None]).sum(-1)
        images, alphas, _ = gsplat.rasterization(
            means,
            None,  # quats and scales, which covars stands for
            None,
            opacities,
            features,
            torch.tensor(np.stack([view.camera.w2c for view in views]), dtype=torch.float32, device=device),
            torch.tensor(np.stack([view.camera.K for view in views]), dtype=torch.float32, device=device),
            width,
            height,
            near_plane=NEAR_PLANE,
            far_plane=math.inf,
            radius_clip=0.0,
            eps2d=BLUR_VARIANCE,
            packed=False,  # the packed layout saves memory on many cameras and is slower on few
            backgrounds=_flat_backgrounds(views, channels, device) if colored and channels else None,
            render_mode=mode,
            channel_chunk=MAX_CHANNELS + 1,  # depth, too, in one pass: gsplat has a kernel for 33 channels
            rasterize_mode="classic",
            covars=covariances,
        )
    return [
        _image(view, channels, images[i] if images is not None and colored else None,
               None if alphas is None else alphas[i, :, :, 0], device)
        for i, view in enumerate(views)
    ]  # fmt: skip


def _flat_backgrounds(views: Sequence[CameraArguments], channels: int, device: torch.device) -> Tensor | None:
    """[views, channels]: backgrounds of one color, which gsplat composites; 0 for those that are images."""
    flat = [view.background if view.background is not None and view.background.ndim == 1 else None for view in views]
    if all(background is None for background in flat):
        return None
    black = torch.zeros(channels, device=device)
    return torch.stack([black if background is None else background for background in flat])


def _image(
    view: CameraArguments, channels: int, color: Tensor | None, opacity: Tensor | None, device: torch.device
) -> tuple[Tensor, Tensor]:
    """One view's color and opacity, its background image and modes applied. None: not rendered for any tile."""
    behind = torch.zeros(channels, device=device) if view.background is None else view.background
    if view.depth:
        behind = torch.cat([behind, behind.new_zeros((*behind.shape[:-1], 1))], dim=-1)
    if opacity is None:
        opacity = torch.zeros(view.size, device=device)
    if color is None:
        color = behind.expand(*view.size, -1).clone()
    elif behind.ndim == 3:
        color = color + (1 - opacity)[..., None] * behind
    if view.modes is not None:
        modes = torch.from_numpy(view.modes).to(device)
        modes = modes.repeat_interleave(TILE_HEIGHT, 0).repeat_interleave(TILE_WIDTH, 1)
        modes = modes[: view.camera.height, : view.camera.width]
        color = torch.where((modes == COLOR)[..., None], color, behind)
        opacity = torch.where(modes != SKIP, opacity, 0.0)
    return color, opacity


def _tiles(image: Tensor, view: CameraArguments) -> Tensor:
    """The compact layout (see tiles.to_tiles) of an image [H, W, C]: [K, C, TILE_HEIGHT, TILE_WIDTH]."""
    rows, columns = tile_grid(view.camera.width, view.camera.height)
    beyond = (0, 0, 0, columns * TILE_WIDTH - view.camera.width, 0, rows * TILE_HEIGHT - view.camera.height)
    padded = torch.nn.functional.pad(image, beyond)
    tiles = padded.reshape(rows, TILE_HEIGHT, columns, TILE_WIDTH, image.shape[2]).permute(0, 2, 4, 1, 3).flatten(0, 1)
    if view.modes is None:
        return tiles
    return tiles.index_select(0, torch.from_numpy(np.flatnonzero(view.modes)).to(image.device))
