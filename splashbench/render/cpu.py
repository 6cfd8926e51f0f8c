"""Gaussians to pixels on the CPU: the array-level forward and backward passes around the compiled kernels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from splashbench.parallel import on_all_threads
from splashbench.render import compositing, counters, projection, tiles
from splashbench.scene.camera import Camera

Floats = NDArray[np.float32]


@dataclass
class Rendering:
    """What one forward pass leaves for the backward pass. `rgb` [H, W, 3] and `alpha` [H, W] are the images."""

    rgb: Floats
    alpha: Floats
    means: Floats
    covariances: Floats
    opacities: Floats
    camera: Floats
    background: Floats
    mask: NDArray[np.bool_]
    ids: NDArray[np.int64]
    splats: Floats
    slot_starts: NDArray[np.int64]
    tile_starts: NDArray[np.int64]
    entries: NDArray[np.int32]
    order: NDArray[np.int64]
    transmittance: Floats
    last: Floats


def _floats(array: NDArray, name: str, shape: tuple[int, ...]) -> Floats:
    """`array` as the kernels want it: float32, C order, writeable (numba compiles anew for anything else)."""
    result: Floats = np.require(array, dtype=np.float32, requirements=["C", "W"])
    if result.shape != shape:
        raise ValueError(f"{name} is {result.shape}, not {shape}")
    return result


def _background(background: NDArray | None, height: int, width: int) -> Floats:
    if background is None:
        return np.zeros((1, 1, 3), np.float32)
    array = np.asarray(background)
    if array.shape == (3,):
        return _floats(array.reshape(1, 1, 3), "background", (1, 1, 3))
    return _floats(array, "background", (height, width, 3))


def forward(
    means: NDArray,
    covariances: NDArray,
    opacities: NDArray,
    colors: NDArray,
    camera: Camera,
    background: NDArray | None = None,
    tile_mask: NDArray[np.bool_] | None = None,
) -> Rendering:
    """Render N Gaussians; see `splashbench.render.rasterize` for the arguments. Raises ValueError on wrong shapes."""
    n = len(means)
    means = _floats(means, "means", (n, 3))
    covariances = _floats(covariances, "covariances", (n, 3, 3))
    opacities = _floats(opacities, "opacities", (n,))
    colors = _floats(colors, "colors", (n, 3))
    height, width = camera.height, camera.width
    grid = tiles.tile_grid(width, height)
    mask = np.ones(grid, bool) if tile_mask is None else np.require(tile_mask, bool, ["C", "W"])
    if mask.shape != grid:
        raise ValueError(f"tile_mask is {mask.shape}, not {grid}; make it with splashbench.render.tile_mask")
    behind = _background(background, height, width)
    counters.record(n)

    row = projection.camera_row(camera.K, camera.w2c, width, height)
    splats = np.empty((n, projection.SPLAT_COLUMNS), np.float32)
    depths = np.empty(n, np.float32)

    def project(worker: int, workers: int) -> None:
        start, stop = worker * n // workers, (worker + 1) * n // workers
        projection.project(means, covariances, opacities, colors, row, width, height, start, stop, splats, depths)

    on_all_threads(project)
    ids, splats, slot_starts, tile_starts, entries = tiles.sort_into_tiles(splats, depths, mask)
    # Longest lists first, dealt to the workers in turn, so that all finish at about the same time.
    order = np.argsort(-np.diff(tile_starts), kind="stable")
    rgb = np.empty((height, width, 3), np.float32)
    transmittance = np.empty((height, width), np.float32)
    last = np.empty((height, width), np.float32)

    def composite(worker: int, workers: int) -> None:
        compositing.composite(
            splats, tile_starts, entries, mask, order, worker, workers, behind, rgb, transmittance, last
        )

    on_all_threads(composite)
    return Rendering(
        rgb, 1 - transmittance, means, covariances, opacities, row, behind, mask, ids, splats, slot_starts,
        tile_starts, entries, order, transmittance, last,
    )  # fmt: skip


def backward(rendering: Rendering, grad_rgb: NDArray, grad_alpha: NDArray) -> tuple[Floats, Floats, Floats, Floats]:
    """Gradients of means [N, 3], covariances [N, 3, 3] (symmetric), opacities [N] and colors [N, 3].

    grad_rgb [H, W, 3] and grad_alpha [H, W] are the gradients of the loss with respect to the images.
    """
    r = rendering
    height, width = r.transmittance.shape
    grad_rgb = _floats(grad_rgb, "grad_rgb", (height, width, 3))
    grad_alpha = _floats(grad_alpha, "grad_alpha", (height, width))
    slots = np.empty((len(r.entries), 9), np.float32)
    lengths = np.diff(r.tile_starts)
    order = r.order[: int(np.count_nonzero(lengths))]

    def composite(worker: int, workers: int) -> None:
        compositing.composite_backward(
            r.splats, r.tile_starts, r.entries, r.mask, order, worker, workers, r.background,
            r.transmittance, r.last, grad_rgb, grad_alpha, slots,
        )  # fmt: skip

    on_all_threads(composite)
    n, drawn = len(r.means), len(r.ids)
    gradients = (
        np.zeros((n, 3), np.float32),
        np.zeros((n, 3, 3), np.float32),
        np.zeros(n, np.float32),
        np.zeros((n, 3), np.float32),
    )

    def project(worker: int, workers: int) -> None:
        start, stop = worker * drawn // workers, (worker + 1) * drawn // workers
        projection.project_backward(
            r.means, r.covariances, r.opacities, r.camera, r.ids, r.splats, slots, r.slot_starts, start, stop,
            *gradients,
        )  # fmt: skip

    on_all_threads(project)
    return gradients
