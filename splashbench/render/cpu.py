"""Gaussians to pixels on the CPU: arrays in, arrays out, around the compiled kernel.

`forward` leaves a Rendering, whose `backward` gives the gradients; `freeze` prepares Gaussians that never change;
`compositing_weights` says what each one makes up of an image.
"""

from __future__ import annotations

import ctypes
import threading
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splashbench.native import memory
from splashbench.native.library import DONE, NOT_FINITE, OUT_OF_MEMORY, TOO_LARGE
from splashbench.native.threads import kernel_threads
from splashbench.render import arguments, counters
from splashbench.render.arguments import Floats
from splashbench.render.constants import TILE_HEIGHT, TILE_WIDTH
from splashbench.render.native import KERNEL, CameraStruct, GaussiansStruct, GradientsStruct, OutputStruct
from splashbench.render.tiles import SKIP, Modes, tile_grid
from splashbench.scene.camera import Camera


def _address(array: NDArray | None) -> int | None:
    return None if array is None else array.__array_interface__["data"][0]


def _camera(camera: Camera) -> CameraStruct:
    K = camera.K
    matrix = (ctypes.c_double * 12)(*camera.w2c[:3].ravel().tolist())
    return CameraStruct(matrix, K[0, 0], K[1, 1], K[0, 2], K[1, 2], camera.width, camera.height)


class _Handle:
    """Owns a frame of the kernel, and what the kernel reads through it.

    Made before the frame: an interrupt that arrives with the frame must find it owned. `lock`: a frame computes one
    backward pass at a time.
    """

    _release: Any = None  # stays None where there is no kernel to load

    def __init__(self, *alive: Any) -> None:
        self.frame, self._alive = ctypes.c_void_p(), alive
        self.lock = threading.Lock()
        self._release = KERNEL.library.splash_release  # at exit the module may be gone first

    def __del__(self) -> None:
        if self._release is not None:
            self._release(self.frame)


@dataclass(frozen=True, eq=False)
class Frozen:
    """Gaussians that never change, projected, sorted and rendered for one camera; made by `freeze`.

    gaussians: means, factors, opacities and colors as `rasterize` takes them.
    """

    camera: Camera
    gaussians: tuple[Floats, Floats, Floats, Floats | None]
    depth: bool
    handle: _Handle

    @property
    def channels(self) -> int:
        """Colour channels, depth not counted."""
        colors = self.gaussians[3]
        return 0 if colors is None else colors.shape[1]

    def __len__(self) -> int:
        return len(self.gaussians[0])

    @property
    def bytes(self) -> int:
        """Memory that the kernel holds for it."""
        return int(KERNEL.library.splash_frame_bytes(self.handle.frame))


@dataclass
class Rendering:
    """One camera's images, and what the backward pass needs. color is [H, W, channels], opacity [H, W], or both
    are compact."""

    color: Floats
    opacity: Floats
    handle: _Handle
    gaussians: tuple[Floats, Floats, Floats, Floats | None]

    def backward(
        self, grad_color: NDArray | None, grad_opacity: NDArray | None, add_to: tuple[Floats | None, ...] | None = None
    ) -> tuple[Floats, Floats, Floats, Floats | None]:
        """Gradients of means [N, 3], factors [N, 3, 3], opacities [N] and colors [N, C] (None where there are none).

        grad_color, grad_opacity: of the loss with respect to the images, in their shapes; None for zero.
        add_to: gradients to add these to, and to return.
        """
        outer = []
        for name, grad, image in (
            ("grad_color", grad_color, self.color),
            ("grad_opacity", grad_opacity, self.opacity),
        ):
            if grad is not None:
                grad = arguments.floats(grad, name)
                if grad.shape != image.shape:
                    raise ValueError(f"{name} is {list(grad.shape)}, not {list(image.shape)}")
            outer.append(grad)
        gradients = add_to or tuple(None if a is None else memory.empty(a.shape) for a in self.gaussians)
        into = GradientsStruct(int(add_to is not None), *map(_address, gradients))
        backward = KERNEL.library.splash_backward
        with self.handle.lock:
            status = backward(self.handle.frame, *map(_address, outer), kernel_threads(), ctypes.byref(into))
        _raise_for(status, self.gaussians)
        return gradients  # type: ignore[return-value]

    def counts(self) -> dict[str, int]:
        """Gaussians drawn, (Gaussian, tile) pairs, and tiles that hold any."""
        counts = (ctypes.c_int64 * 3)()
        KERNEL.library.splash_frame_counts(self.handle.frame, counts)
        return dict(zip(("drawn", "pairs", "tiles"), counts))


def _raise_for(status: int, gaussians: tuple[Floats, Floats, Floats, Floats | None]) -> None:
    if status == DONE:
        return
    if status == NOT_FINITE:
        arguments.check_finite(*gaussians)
        raise ValueError("the Gaussians held values that are not finite, and were changed since")
    if status == OUT_OF_MEMORY:
        raise MemoryError("the renderer is out of memory: fewer Gaussians, smaller ones or smaller images need less")
    if status == TOO_LARGE:
        raise ValueError(f"means has {len(gaussians[0])} rows; the renderer takes fewer than 2^31")
    raise RuntimeError(f"the renderer's kernel answered {status}")


def _gaussians(
    means: Any, factors: Any, opacities: Any, colors: Any
) -> tuple[tuple[Floats, Floats, Floats, Floats | None], GaussiansStruct]:
    arrays = (
        arguments.floats(means, "means"),
        arguments.floats(factors, "factors"),
        arguments.floats(opacities, "opacities"),
        None if colors is None else arguments.floats(colors, "colors"),
    )
    channels = arguments.check_shapes(*arrays)
    return arrays, GaussiansStruct(len(arrays[0]), channels, *map(_address, arrays))


def freeze(means: Any, factors: Any, opacities: Any, colors: Any, camera: Camera, *, depth: bool = False) -> Frozen:
    """Prepare Gaussians that never change for one camera: projected, sorted and drawn once.

    The arguments are those of `rasterize` (tensors or arrays; values are copied). Give the result to `rasterize` as
    `frozen`, with as many channels, and the same `depth`. It holds an image of this camera's size (see `bytes`).
    Raises ValueError or TypeError naming the argument.
    """
    arguments.check_camera(camera)
    depth = arguments.check_flag(depth, "depth")
    arrays, gaussians = _gaussians(means, factors, opacities, colors)
    # These arrays outlive this call: later changes by the caller must not reach them.
    arrays = tuple(None if a is None else a.copy() for a in arrays)  # type: ignore[assignment]
    gaussians = GaussiansStruct(len(arrays[0]), gaussians.channels, *map(_address, arrays))
    handle = _Handle(arrays)
    status = KERNEL.library.splash_freeze(
        ctypes.byref(_camera(camera)), ctypes.byref(gaussians), int(depth), kernel_threads(), ctypes.byref(handle.frame)
    )
    _raise_for(status, arrays)
    return Frozen(camera, arrays, depth, handle)


def forward(
    means: Any,
    factors: Any,
    opacities: Any,
    colors: Any,
    camera: Camera,
    *,
    background: Any = None,
    modes: Any = None,
    frozen: Frozen | None = None,
    depth: bool = False,
    compact: bool = False,
    for_backward: bool = False,
) -> Rendering:
    """Render for one camera; the arguments are those of `splashbench.render.rasterize`.

    for_backward: keep a copy of the background. Without it, neither may it change before the rendering's `backward`.
    """
    arguments.check_camera(camera)
    arrays, gaussians = _gaussians(means, factors, opacities, colors)
    channels = gaussians.channels + int(depth)
    arguments.check_frozen(frozen, camera, gaussians.channels, depth)
    behind = arguments.check_background(background, camera, gaussians.channels)
    if behind is not None and for_backward and arguments.is_callers(behind, background):
        behind = behind.copy()  # read again by the backward pass, which the caller's later changes must not reach
    if behind is not None and depth:
        behind = np.concatenate([behind, np.zeros((*behind.shape[:-1], 1), np.float32)], axis=-1)
    tile_modes: Modes | None = arguments.check_modes(modes, camera)
    shape: tuple[int, ...] = (camera.height, camera.width)
    color_shape = (*shape, channels)
    if compact:
        rows, columns = tile_grid(camera.width, camera.height)
        tile_count = rows * columns if tile_modes is None else int(np.count_nonzero(tile_modes != SKIP))
        shape = (tile_count, TILE_HEIGHT, TILE_WIDTH)
        color_shape = (tile_count, channels, TILE_HEIGHT, TILE_WIDTH)
    color, opacity = memory.empty(color_shape), memory.empty(shape)
    output = OutputStruct(
        int(depth),
        int(compact),
        int(behind is not None and behind.ndim == 3),
        _address(tile_modes),
        _address(behind),
        _address(color),
        _address(opacity),
    )
    handle = _Handle(arrays, behind, frozen)
    status = KERNEL.library.splash_forward(
        ctypes.byref(_camera(camera)),
        ctypes.byref(gaussians),
        ctypes.byref(output),
        None if frozen is None else frozen.handle.frame,
        kernel_threads(),
        ctypes.byref(handle.frame),
    )
    _raise_for(status, arrays)
    counters.record(len(arrays[0]) + (0 if frozen is None else len(frozen)), f"cpu ({KERNEL.variant})")
    return Rendering(color, opacity, handle, arrays)


def compositing_weights(
    means: Any,
    factors: Any,
    opacities: Any,
    camera: Camera,
    *,
    counts: Any = None,
    frozen: Frozen | None = None,
) -> Floats:
    """Pixels that each of N Gaussians makes up: its compositing weights summed over the image, float32 [N].

    means, factors, opacities, frozen: as `splashbench.render.rasterize` takes them. counts: [H, W], how much each pixel
    counts; 1 by default. This is the derivative of a channel, summed over pixels, by the Gaussian's colour in it, and
    costs as much as an image of opacity. Raises ValueError or TypeError naming the argument.
    """
    arguments.check_camera(camera)
    arrays, gaussians = _gaussians(means, factors, opacities, None)
    arguments.check_frozen(frozen, camera, getattr(frozen, "channels", 0), getattr(frozen, "depth", False))
    by_pixel = None if counts is None else arguments.floats(counts, "counts")
    if by_pixel is not None and by_pixel.shape != (camera.height, camera.width):
        raise ValueError(f"counts is {list(by_pixel.shape)}, not {[camera.height, camera.width]}")
    if by_pixel is not None and not np.isfinite(by_pixel).all():
        raise ValueError("counts holds values that are not finite")
    found = memory.empty((len(arrays[0]),))
    status = KERNEL.library.splash_weigh(
        ctypes.byref(_camera(camera)),
        ctypes.byref(gaussians),
        _address(by_pixel),
        None if frozen is None else frozen.handle.frame,
        kernel_threads(),
        _address(found),
    )
    _raise_for(status, arrays)
    return found
