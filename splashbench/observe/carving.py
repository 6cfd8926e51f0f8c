"""The distance of a grid's nodes to one view's silhouette cone (paper, "Observed geometry"), by the compiled kernel.

`hull` has the formula, and `occlusion` what a container hides from the view.
"""

from __future__ import annotations

import ctypes
from ctypes import POINTER, Structure, c_double, c_float, c_int32, c_void_p
from pathlib import Path

import numpy as np

from splashbench.native.library import CompiledKernel
from splashbench.native.threads import kernel_threads

#: Nodes along the edge of a block, see `carve_view`.
BLOCK = 4


class _Carving(Structure):
    """SplashCarving of api.h."""

    _fields_ = (
        ("shape", c_int32 * 3),
        ("phi", c_void_p),
        ("second", c_void_p),
        ("block", c_int32),
        ("blocks", c_void_p),
        ("origin", c_double * 3),
        ("voxel", c_double),
        ("projection", c_double * 12),
        ("focal", c_double),
        ("height", c_int32),
        ("width", c_int32),
        ("corner", c_double * 2),
        ("starts_count", c_int32),
        ("starts", c_void_p),
        ("layers", c_void_p),
        ("nearest", c_void_p),
        ("tolerance", c_double),
        ("limit", c_float),
    )


KERNEL = CompiledKernel(
    "observe",
    Path(__file__).parent / "kernel",
    abi_version=1,
    functions={"splash_carve": (None, (POINTER(_Carving), c_int32))},
)

# Pixels of all layers together are counted in 32 bits.
_MOST_PIXELS = 2**31 - 1
_NOTHING_BEFORE = np.zeros(0)
_NO_SURFACE = np.zeros((0, 0), dtype=np.float32)


def blocks_of(shape: tuple[int, ...]) -> tuple[int, int, int]:
    """How many blocks of `BLOCK` nodes a side a grid of `shape` has along each axis."""
    nx, ny, nz = (-(-n // BLOCK) for n in shape)
    return nx, ny, nz


def carve_view(
    phi: np.ndarray,
    origin: np.ndarray,
    voxel: float,
    projection: np.ndarray,
    focal: float,
    silhouette: np.ndarray,
    corner: np.ndarray,
    limit: float,
    blocks: np.ndarray | None = None,
) -> None:
    """phi = max(phi, distance to one view's silhouette cone), in place, in voxels, clipped to +-`limit`.

    phi: float32 [nx, ny, nz]. projection: [3, 4], scene to pixels. silhouette: float32 [h, w], signed distance in
    pixels to the mask's outline, negative inside, of the image window whose top-left pixel is `corner` (x, y); two
    pixels a side at least. One pixel at depth z spans z / focal scene units. Points behind the camera are outside.
    blocks: bool, of `BLOCK` nodes a side, see `blocks_of`: those that are looked at, by default all.

    Raises TypeError or ValueError naming the argument.
    """
    if silhouette.ndim != 2 or min(silhouette.shape) < 2:
        raise ValueError(f"silhouette is {list(silhouette.shape)}, not an image with sides of 2 pixels or more")
    # A view from which nothing is hidden.
    carve_hidden_view(
        phi,
        origin,
        voxel,
        projection,
        focal,
        silhouette[None],
        corner,
        _NO_SURFACE,
        _NOTHING_BEFORE,
        0.0,
        limit,
        blocks=blocks,
    )


def carve_hidden_view(
    phi: np.ndarray,
    origin: np.ndarray,
    voxel: float,
    projection: np.ndarray,
    focal: float,
    layers: np.ndarray,
    corner: np.ndarray,
    nearest: np.ndarray,
    starts: np.ndarray,
    tolerance: float,
    limit: float,
    second: np.ndarray | None = None,
    blocks: np.ndarray | None = None,
) -> None:
    """As `carve_view`, for a view from which an occluder hides what lies more than `tolerance` behind it.

    layers: float32 [K + 1, h, w], signed distances in pixels of the evidence at growing depths; layer k counts for
    depths from starts[k - 1] on (starts: [K], scene units, rising). nearest: float32 [h, w], depth of the occluder. A
    point that is hidden at its own depth looks one layer deeper, where its pixel is hidden too.

    second: float32 [nx, ny, nz]; where given, phi collects the largest and `second` the second largest value of all
    views that are added one after the other, instead of the maximum alone. Both begin at -`limit`, and a view says
    nothing of points behind its camera.
    """
    starts = np.ascontiguousarray(starts, np.float64)
    origin, projection, corner = (np.asarray(place, np.float64) for place in (origin, projection, corner))
    blocks = None if blocks is None else np.ascontiguousarray(blocks, np.bool_)
    for name, value in (("voxel", voxel), ("focal", focal), ("limit", limit)):
        if not 0 < value < np.inf:
            raise ValueError(f"{name} is {value}, not a positive number")
    for name, field in (("phi", phi), ("second", second)):
        if field is not None and (field.dtype != np.float32 or not field.flags.c_contiguous):
            raise TypeError(f"{name} is not contiguous float32")
        if field is not None and not field.flags.writeable:
            raise ValueError(f"{name} is read-only")
    if phi.ndim != 3:
        raise ValueError(f"phi has {phi.ndim} dimensions, not 3")
    if layers.ndim != 3 or min(layers.shape) < 1 or min(layers.shape[1:]) < 2:
        raise ValueError(f"layers are {list(layers.shape)}, not one image or more with sides of 2 pixels or more")
    if layers.size > _MOST_PIXELS:
        raise ValueError(f"layers have {layers.size} pixels, more than {_MOST_PIXELS}")
    layers, nearest = (np.ascontiguousarray(image, np.float32) for image in (layers, nearest))
    wanted = {
        "second": (second, phi.shape),
        "blocks": (blocks, blocks_of(phi.shape)),
        "starts": (starts, (len(layers) - 1,)),
        "nearest": (nearest if len(starts) else None, layers.shape[1:]),
        "projection": (projection, (3, 4)),
        "origin": (origin, (3,)),
        "corner": (corner, (2,)),
    }
    for name, (array, shape) in wanted.items():
        if array is not None and array.shape != shape:
            raise ValueError(f"{name} is {list(array.shape)}, not {list(shape)}")
    carving = _Carving(
        (c_int32 * 3)(*phi.shape),
        phi.ctypes.data,
        None if second is None else second.ctypes.data,
        BLOCK,
        None if blocks is None else blocks.ctypes.data,
        (c_double * 3)(*origin),
        voxel,
        (c_double * 12)(*np.ravel(projection)),
        focal,
        *layers.shape[1:],
        (c_double * 2)(*corner),
        len(starts),
        starts.ctypes.data,
        layers.ctypes.data,
        nearest.ctypes.data,
        tolerance,
        limit,
    )
    KERNEL.library.splash_carve(ctypes.byref(carving), kernel_threads())
