"""Checks what callers hand to the renderer, the same for every backend: shapes, dtypes, finite values.

Errors name the argument. What can be converted without loss of meaning (float64, other memory layouts) is.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from splashbench.render.native import MAX_CHANNELS
from splashbench.render.tiles import COLOR, SKIP, Modes, tile_grid
from splashbench.scene.camera import Camera

Floats = NDArray[np.float32]

GAUSSIANS = ("means", "factors", "opacities", "colors")
LARGEST_SIDE = 1 << 17
LARGEST_INTRINSIC = 1e9


def floats(value: Any, name: str) -> Floats:
    """`value` (array, tensor or nested list of floating point numbers) as a C-contiguous float32 array."""
    try:
        if hasattr(value, "detach"):  # a torch tensor; torch need not be there
            value = value.detach().cpu()
            if value.is_floating_point():
                value = value.float()
            value = value.numpy()
        array = np.asarray(value)
    except (NotImplementedError, RuntimeError, TypeError, ValueError) as error:
        raise TypeError(f"{name} cannot be read as an array of numbers: {error}") from None
    if array.dtype.kind != "f" and array.size:
        raise TypeError(f"{name} is {array.dtype}, not floating point")
    with np.errstate(over="ignore"):  # what overflows is infinite, and refused as that
        return np.require(array, np.float32, ["C", "A"])


def is_callers(array: Floats, value: Any) -> bool:
    """Whether the `array` that `floats` made of `value` lies where that does, as it needed no conversion."""
    place = value.data_ptr() if hasattr(value, "data_ptr") else np.asarray(value).__array_interface__["data"][0]
    return bool(place == array.__array_interface__["data"][0])


def check_shapes(means: Any, factors: Any, opacities: Any, colors: Any) -> int:
    """The number of colour channels; raises ValueError where the Gaussians' arrays do not fit together."""
    if np.ndim(means) != 2 or means.shape[1] != 3:
        raise ValueError(f"means is {list(np.shape(means))}, not [N, 3]")
    n = len(means)
    expected = {"factors": (factors, (n, 3, 3)), "opacities": (opacities, (n,))}
    for name, (value, shape) in expected.items():
        if tuple(np.shape(value)) != shape:
            raise ValueError(f"{name} is {list(np.shape(value))}, not {list(shape)} (means has {n} rows)")
    if colors is None:
        return 0
    shape = tuple(np.shape(colors))
    if len(shape) != 2 or shape[0] != n or not 1 <= shape[1] <= MAX_CHANNELS:
        raise ValueError(f"colors is {list(shape)}, not [{n}, C] with 1 to {MAX_CHANNELS} channels")
    return shape[1]


def check_finite(means: Floats, factors: Floats, opacities: Floats, colors: Floats | None) -> None:
    """Raise ValueError naming the first argument, and its first row, that holds a NaN or an infinity."""
    arrays: tuple[Floats | None, ...] = (means, factors, opacities, colors)
    for name, array in zip(GAUSSIANS, arrays):
        if array is None:
            continue
        bad = np.flatnonzero(~np.isfinite(array.reshape(len(array), -1)).all(axis=1))
        if len(bad):
            raise ValueError(f"{name} is not finite in {len(bad)} of {len(array)} rows, first in row {bad[0]}")


def check_camera(camera: Any) -> Camera:
    """`camera` itself; TypeError or ValueError where the renderer cannot take it."""
    if not isinstance(camera, Camera):
        raise TypeError(f"cameras is a {type(camera).__name__}, not a splashbench.scene.Camera or a sequence of them")
    sizes = (camera.width, camera.height)
    if not all(isinstance(size, int | np.integer) and size <= LARGEST_SIDE for size in sizes):
        raise ValueError(
            f"cameras: camera {camera.name} is {sizes} px; the renderer takes whole numbers to {LARGEST_SIDE}"
        )
    if np.abs(camera.K).max() > LARGEST_INTRINSIC:
        raise ValueError(f"cameras: K of camera {camera.name} has entries above {LARGEST_INTRINSIC:g} px")
    skew = camera.K[0, 1]
    if skew != 0 or (camera.K[1, 0], camera.K[2, 0], camera.K[2, 1], camera.K[2, 2]) != (0, 0, 0, 1):
        raise ValueError(f"cameras: K of camera {camera.name} is not a pinhole's without skew (K[0, 1] is {skew})")
    return camera


def check_background(background: Any, camera: Camera, channels: int) -> Floats | None:
    """The background as float32 [channels] or [H, W, channels]."""
    if background is None:
        return None
    array = floats(background, "background")
    if array.shape not in ((channels,), (camera.height, camera.width, channels)):
        raise ValueError(
            f"background is {list(array.shape)}, not [{channels}] or [{camera.height}, {camera.width}, {channels}]"
        )
    # The sum is not finite where an entry is not (or, at worst, where it overflows).
    with np.errstate(invalid="ignore", over="ignore"):
        total = array.sum(dtype=np.float64)
    if not np.isfinite(total) and not np.isfinite(array).all():
        raise ValueError("background holds values that are not finite")
    return array


def check_modes(modes: Any, camera: Camera) -> Modes | None:
    """The modes as uint8 [tile rows, tile columns]; a bool array means COLOR where True, else SKIP."""
    if modes is None:
        return None
    try:
        array = np.asarray(modes.detach().cpu() if hasattr(modes, "detach") else modes)
    except (NotImplementedError, RuntimeError, TypeError, ValueError) as error:
        raise TypeError(f"modes cannot be read as an array of numbers: {error}") from None
    grid = tile_grid(camera.width, camera.height)
    if array.shape != grid:
        raise ValueError(
            f"modes is {list(array.shape)}, not {list(grid)} for {camera.width}x{camera.height} px; "
            "make it with splashbench.render.tile_modes"
        )
    if array.dtype == bool:
        return np.where(array, COLOR, SKIP).astype(np.uint8)
    if array.dtype.kind not in "ui" or (array.size and (array.min() < SKIP or array.max() > COLOR)):
        raise ValueError("modes holds other values than SKIP, OPACITY and COLOR; make it with tile_modes")
    return np.ascontiguousarray(array, np.uint8)


def check_tensor(value: Any, name: str, optional: bool = False) -> None:
    """Raise TypeError unless `value` is a torch tensor of floating point numbers (or None, where that is allowed)."""
    if value is None and optional:
        return
    if not hasattr(value, "is_floating_point"):
        raise TypeError(f"{name} is a {type(value).__name__}, not a torch tensor")
    if not value.is_floating_point():
        raise TypeError(f"{name} is {value.dtype}, not floating point")
    if value.is_meta or value.is_sparse:
        raise TypeError(f"{name} holds no dense values (a sparse tensor, or one on the meta device)")


def check_flag(value: Any, name: str) -> bool:
    """`value` itself; TypeError unless it is a bool."""
    if not isinstance(value, bool | np.bool_):
        raise TypeError(f"{name} is {value!r}, not True or False")
    return bool(value)


def check_frozen(frozen: Any, camera: Camera, channels: int, depth: bool) -> None:
    """Raise ValueError unless `frozen` is None or was made for this camera and these channels."""
    if frozen is None:
        return
    if not hasattr(frozen, "gaussians"):
        raise TypeError(f"frozen is a {type(frozen).__name__}, not what splashbench.render.freeze makes")
    same = (
        (frozen.camera.width, frozen.camera.height) == (camera.width, camera.height)
        and np.array_equal(frozen.camera.K, camera.K)
        and np.array_equal(frozen.camera.w2c, camera.w2c)
    )
    if not same:
        raise ValueError(f"frozen was made for another camera than {camera.name}; call freeze for each camera")
    if (frozen.channels, frozen.depth) != (channels, depth):
        raise ValueError(
            f"frozen has {frozen.channels} channels (depth {frozen.depth}), colors {channels} (depth {depth})"
        )
