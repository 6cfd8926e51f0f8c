"""The renderer's definition in plain torch: any dtype, differentiable by autograd throughout, made to be read.

The tests hold the fast renderers against it, in float64 above all, and benchmarks/render.py compares speeds with it.
It goes over tiles of 16 x 16 pixels and blends each tile's Gaussians in one tensor [pixels, Gaussians]. Only Gaussians
that stay below MIN_ALPHA all over a tile are left out there, so the tiles do not affect the image. The numbers are in
splashbench/render/constants.py; they and the formulas are those of gsplat 1.5.3, classic mode:

    image covariance  S = J R B (J R B)^T + BLUR_VARIANCE I,  R: world to camera, J: Jacobian of the projection
    alpha at offset d  a = min(opacity exp(-d^T S^-1 d / 2), MAX_ALPHA), or 0 where this is below MIN_ALPHA
    transmittance     T_1 = 1,  T_i+1 = T_i (1 - a_i),  from front to back; the first Gaussian with
                      T_i+1 <= MIN_TRANSMITTANCE is left out of its pixel, and so is everything behind it
    color             sum_i a_i T_i c_i + T background,  opacity 1 - T,  T: what is left at the end
    depth             sum_i a_i T_i z_i
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import torch

from splashbench.render.constants import (
    BLUR_VARIANCE,
    JACOBIAN_MARGIN,
    MAX_ALPHA,
    MIN_ALPHA,
    MIN_TRANSMITTANCE,
    NEAR_PLANE,
)
from splashbench.scene.camera import Camera

TILE = 16
"""Side of a tile, px."""


class Splats(NamedTuple):
    """The M of the N Gaussians that are drawn, as the image sees them, from front to back."""

    ids: torch.Tensor  # int64 [M], the Gaussian behind each splat
    centers: torch.Tensor  # [M, 2], px: column, row
    covariances: torch.Tensor  # [M, 3], px^2, blurred: xx, xy, yy
    opacities: torch.Tensor  # [M]
    depths: torch.Tensor  # [M], along the optical axis, scene units
    slopes: torch.Tensor  # [M, 2]: x / z and y / z, not clamped


class Tile(NamedTuple):
    """A rectangle of pixels and the splats that may be seen there."""

    rows: slice
    columns: slice
    members: torch.Tensor  # int64 [L], indices into the splats, from front to back


def slope_limits(camera: Camera, dtype: torch.dtype) -> tuple[torch.Tensor, torch.Tensor]:
    """Lowest and highest (x / z, y / z) at which the projection is linearized, [2] each."""
    K, size = torch.tensor(camera.K, dtype=dtype), torch.tensor([camera.width, camera.height], dtype=dtype)
    focal, principal_point, margin = K.diagonal()[:2], K[:2, 2], JACOBIAN_MARGIN * size
    return (-margin - principal_point) / focal, (size + margin - principal_point) / focal


def project(
    means: torch.Tensor, factors: torch.Tensor, opacities: torch.Tensor, camera: Camera, tolerance: float = 0.0
) -> Splats:
    """The Gaussians (arguments as in `rasterize`) in front of the near plane and not too faint, as splats.

    tolerance: Gaussians that fail either condition by less than this, relatively, are kept too.
    """
    K, w2c = torch.tensor(camera.K, dtype=means.dtype), torch.tensor(camera.w2c, dtype=means.dtype)
    rotation, translation = w2c[:3, :3], w2c[:3, 3]
    focal, principal_point = K.diagonal()[:2], K[:2, 2]
    local = means @ rotation.T + translation
    drawn = (local[:, 2] >= NEAR_PLANE * (1 - tolerance)) & (opacities >= MIN_ALPHA * (1 - tolerance))
    ids = torch.nonzero(drawn)[:, 0]
    ids = ids[torch.argsort(local[ids, 2], stable=True)]  # stable: Gaussians of equal depth keep their order
    local = local[ids]
    slopes, depths = local[:, :2] / local[:, 2:], local[:, 2]
    # J = [[fx, 0, -fx x/z], [0, fy, -fy y/z]] / z
    last_columns = -focal * slopes.clamp(*slope_limits(camera, means.dtype))
    jacobians = torch.cat([torch.diag(focal).expand(len(ids), 2, 2), last_columns[:, :, None]], 2)
    projected = jacobians / depths[:, None, None] @ rotation @ factors[ids]
    x, y = projected.unbind(1)
    xx, xy, yy = (x * x).sum(1) + BLUR_VARIANCE, (x * y).sum(1), (y * y).sum(1) + BLUR_VARIANCE
    covariances = torch.stack([xx, xy, yy], 1)
    return Splats(ids, focal * slopes + principal_point, covariances, opacities[ids], depths, slopes)


@torch.no_grad()
def tiles_of(splats: Splats, camera: Camera) -> Iterator[Tile]:
    """The image's tiles, row by row, each with the splats whose box of alpha >= MIN_ALPHA meets it."""
    # On the ellipse alpha = MIN_ALPHA, d^T S^-1 d is `reach`, and d_x^2 is at most reach S_xx. The pixel more is for
    # rounding: whether a splat is seen at a pixel is decided by its alpha there.
    reach = 2 * torch.log(splats.opacities / MIN_ALPHA).clamp(min=0)
    extents = torch.sqrt(reach[:, None] * splats.covariances[:, [0, 2]]) + 1
    low, high = splats.centers - extents, splats.centers + extents
    for top in range(0, camera.height, TILE):
        bottom = min(top + TILE, camera.height)
        in_band = torch.nonzero((low[:, 1] < bottom) & (high[:, 1] > top))[:, 0]
        for left in range(0, camera.width, TILE):
            right = min(left + TILE, camera.width)
            meets = (low[in_band, 0] < right) & (high[in_band, 0] > left)
            yield Tile(slice(top, bottom), slice(left, right), in_band[meets])


def alphas_in(
    tile: Tile, centers: torch.Tensor, covariances: torch.Tensor, opacities: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """What a tile's L splats hide of its P pixels (row by row), both [P, L].

    The first is opacity exp(-d^T S^-1 d / 2) as it is.
    The second, alpha, is clamped to MAX_ALPHA, and is 0 below MIN_ALPHA.
    """
    rows, columns = torch.meshgrid(
        torch.arange(tile.rows.start, tile.rows.stop, dtype=centers.dtype) + 0.5,
        torch.arange(tile.columns.start, tile.columns.stop, dtype=centers.dtype) + 0.5,
        indexing="ij",
    )
    dx, dy = columns.reshape(-1, 1) - centers[:, 0], rows.reshape(-1, 1) - centers[:, 1]
    xx, xy, yy = covariances.unbind(1)
    squared = (yy * dx**2 - 2 * xy * dx * dy + xx * dy**2) / (xx * yy - xy**2)
    unclamped = opacities * torch.exp(-squared / 2)
    return unclamped, torch.where(unclamped >= MIN_ALPHA, unclamped.clamp(max=MAX_ALPHA), 0)


def transmittances(alphas: torch.Tensor) -> torch.Tensor:
    """What reaches each splat, and at the end what passes all of them: [P, L + 1] from alphas [P, L]."""
    return torch.cumprod(torch.cat([alphas.new_ones((len(alphas), 1)), 1 - alphas], 1), 1)


def blend(alphas: torch.Tensor, features: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """The sums of weight times features [L, F] at P pixels, [P, F], and the transmittance that is left, [P]."""
    with torch.no_grad():
        # The product never rises, so this is false for the first splat that would exhaust the pixel and all behind it.
        kept = transmittances(alphas)[:, 1:] > MIN_TRANSMITTANCE
    alphas = torch.where(kept, alphas, 0)
    reaching = transmittances(alphas)
    return (alphas * reaching[:, :-1]) @ features, reaching[:, -1]


def rasterize(
    means: torch.Tensor,
    factors: torch.Tensor,
    opacities: torch.Tensor,
    colors: torch.Tensor | None,
    camera: Camera,
    *,
    background: torch.Tensor | None = None,
    depth: bool = False,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Render N Gaussians to (color [H, W, C], opacity [H, W]) in the dtype of the arguments, which must be one.

    Args:
        means: [N, 3], scene units. factors: B [N, 3, 3], scene units; a covariance is B B^T.
        opacities: [N], in [0, 1]. colors: [N, C]; None is C = 0.
        background: [C] or [H, W, C], seen through what stays transparent; black by default.
        depth: append sum_i a_i T_i z_i as the last channel of color; the background counts as 0 there.
    """
    splats = project(means, factors, opacities, camera)
    features = means.new_zeros((len(splats.ids), 0)) if colors is None else colors[splats.ids]
    channels = features.shape[1]
    if depth:
        features = torch.cat([features, splats.depths[:, None]], 1)
    tiles = list(tiles_of(splats, camera))
    # One gather for all tiles: its gradient is one scatter.
    table = torch.cat([splats.centers, splats.covariances, splats.opacities[:, None], features], 1)
    gathered = table[torch.cat([tile.members for tile in tiles])].split([len(tile.members) for tile in tiles])
    bands: dict[int, list[torch.Tensor]] = {}  # by first row, the tiles' images [h, w, features and transmittance]
    for tile, columns in zip(tiles, gathered):
        _, alphas = alphas_in(tile, columns[:, :2], columns[:, 2:5], columns[:, 5])
        sums, transmittance = blend(alphas, columns[:, 6:])
        image = torch.cat([sums, transmittance[:, None]], 1)
        height, width = tile.rows.stop - tile.rows.start, tile.columns.stop - tile.columns.start
        bands.setdefault(tile.rows.start, []).append(image.reshape(height, width, -1))
    image = torch.cat([torch.cat(band, 1) for band in bands.values()], 0)
    color, transmittance = image[..., :-1], image[..., -1]
    if background is not None:
        behind = transmittance[..., None] * background
        color = torch.cat([color[..., :channels] + behind, color[..., channels:]], 2)
    return color, 1 - transmittance


@torch.no_grad()
def threshold_pixels(
    means: torch.Tensor,
    factors: torch.Tensor,
    opacities: torch.Tensor,
    camera: Camera,
    tolerance: float = 1e-3,
    depth_tolerance: float = 1e-6,
) -> torch.Tensor:
    """bool [H, W]: where rounding may decide what is drawn, so that float32 and float64 may rightly differ.

    True where one of the Gaussians that light reaches is near a threshold, relative to its value:
    - its alpha within `tolerance` of MIN_ALPHA or MAX_ALPHA;
    - the transmittance that it leaves within `tolerance` of MIN_TRANSMITTANCE;
    - its place, if it is seen there, within `tolerance` of the near plane or of where the Jacobian is clamped;
    - its depth within `depth_tolerance` of its neighbor's in the order. Equal depths are no doubt: the order of the
      input decides.
    Arguments as in `rasterize`.
    """
    splats = project(means.double(), factors.double(), opacities.double(), camera, tolerance)

    def near(value: torch.Tensor, threshold: float) -> torch.Tensor:
        return (value - threshold).abs() <= tolerance * threshold

    low, high = slope_limits(camera, torch.float64)
    to_limit = torch.minimum((splats.slopes - low).abs(), (splats.slopes - high).abs())
    doubtful = near(splats.depths, NEAR_PLANE) | (to_limit <= tolerance * (high - low)).any(1)
    result = torch.zeros((camera.height, camera.width), dtype=torch.bool)
    for tile in tiles_of(splats, camera):
        m = tile.members
        unclamped, alphas = alphas_in(tile, splats.centers[m], splats.covariances[m], splats.opacities[m])
        reaching = transmittances(alphas)
        seen = alphas > 0
        doubts = near(unclamped, MIN_ALPHA) | near(unclamped, MAX_ALPHA) | near(reaching[:, 1:], MIN_TRANSMITTANCE)
        doubts |= seen & doubtful[m]
        gaps = splats.depths[m].diff()
        swappable = (gaps > 0) & (gaps <= depth_tolerance * splats.depths[m][1:])
        doubts[:, 1:] |= seen[:, 1:] & seen[:, :-1] & swappable
        reached = reaching[:, :-1] > MIN_TRANSMITTANCE
        result[tile.rows, tile.columns] = (doubts & reached).any(1).reshape(result[tile.rows, tile.columns].shape)
    return result
