"""The smallest length that a scene's cameras can show of its liquid, measured in its own footage.

Four things limit it, each in pixels of the training photographs:

- the pixel itself;
- how soft the liquid's edge is: lens, motion during the exposure, compression;
- how far outlines disagree: the rim of each mask that the other views do not allow. Clocks that are off, cameras that
  are off and masks that are off all show there, multiplied by what moves and how far it moves;
- the angle between views: along its line of sight a view sees nothing, and the best pair of views decides.

No grid needs to be finer than that. It is measured before the fit, from a few frames, and needs no calibration data.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from splashbench.observe.container import depth_image, hidden
from splashbench.observe.grid import Bounds
from splashbench.observe.mask_distance import signed_distance_2d
from splashbench.observe.occlusion import ContainerOcclusion, focal_length
from splashbench.observe.silhouettes import Silhouettes
from splashbench.scene.camera import Camera
from splashbench.scene.scene import TrainingScene

# Frames that are looked at, pixels of each outline, and places along each line of sight, a pixel or two apart.
_FRAMES, _PIXELS, _PLACES = 5, 80, 240
# Middles and widths of the rims, in pixels inside the outline.
_RIMS = ((0.5, 1.0), (1.5, 1.0), (2.5, 1.0), (4.0, 2.0), (6.5, 3.0), (10.5, 5.0))
# A place counts as hidden by the container where it lies so many pixels behind it, and as allowed by a mask where it is
# no farther beside it: places along a line of sight are not dense.
_BEHIND, _BESIDE = 2.0, 0.25
# Profiles across outlines reach so many pixels to either side; fewer levels than this are noise.
_REACH, _CONTRAST = 6, 24.0
# Edge of a sharp step between two pixels, by `_softness`.
_SHARP = 1.0


@dataclass(frozen=True)
class Observable:
    """pixel: what a pixel spans at the liquid, scene units, in the middle of the views. edge: how wide the liquid's
    edge is, pixels, 1 where it is as sharp as pixels are; None where photographs do not tell. disagreement: width of
    the rim of masks that other views do not allow, pixels. angle: between the two views that see it most differently,
    degrees.
    """

    pixel: float
    edge: float | None
    disagreement: float
    angle: float

    @property
    def pixels(self) -> float:
        """The smallest length in pixels."""
        soft = (self.edge or _SHARP) ** 2 - _SHARP**2
        across = (1 + max(soft, 0.0) + (2 * self.disagreement) ** 2) ** 0.5
        return across / max(float(np.sin(np.radians(self.angle))), 0.1)

    @property
    def length(self) -> float:
        """The smallest length, scene units."""
        return self.pixel * self.pixels


def observable(
    scene: TrainingScene, silhouettes: Silhouettes, bounds: Bounds, container: ContainerOcclusion | None
) -> Observable:
    """Measure it. silhouettes: of `scene`, or of its masks at a lower resolution. bounds: hold the liquid."""
    middle = (bounds.low + bounds.high) / 2
    names = list(silhouettes.views)
    frames = _frames(silhouettes)
    factor = max(scene.cameras[name].width / camera.width for name, camera in zip(names, silhouettes.cameras))
    return Observable(
        _pixel(scene, names, middle),
        _edge(scene, names, frames),
        factor * _disagreement(silhouettes, frames, bounds, container),
        _angle(scene, names, middle),
    )


def _frames(silhouettes: Silhouettes) -> list[int]:
    """Some frames with liquid, spread over the sequence."""
    wet = [t for t in range(silhouettes.n_frames) if silhouettes.has_liquid(t)]
    return [wet[round(k)] for k in np.linspace(0, len(wet) - 1, min(_FRAMES, len(wet)))] if wet else []


def _pixel(scene: TrainingScene, names: Sequence[str], middle: NDArray[np.float64]) -> float:
    spans = []
    for camera in (scene.cameras[name] for name in names):
        depth = float(camera.w2c[2, :3] @ middle + camera.w2c[2, 3])
        if depth > 0:
            spans.append(depth / focal_length(camera))
    return float(np.median(spans)) if spans else 0.0


def _angle(scene: TrainingScene, names: Sequence[str], middle: NDArray[np.float64]) -> float:
    """The largest angle between two views' lines of sight, at most 90 degrees: beyond, views face each other."""
    rays = np.array([scene.cameras[name].center - middle for name in names])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    crossed = np.linalg.norm(np.cross(rays[:, None], rays[None]), axis=2)
    return float(np.degrees(np.arcsin(np.clip(crossed.max(), 0, 1))))


def _edge(scene: TrainingScene, names: Sequence[str], frames: Sequence[int]) -> float | None:
    """The median over profiles across outlines of their contrast divided by their steepest step, in pixels."""
    widths: list[NDArray[np.floating]] = []
    for name in names:
        for t in frames:
            mask = scene.mask(name, t)
            if mask.any() and not mask.all():
                widths.append(_softness(scene.image(name, t), mask))
    found = np.concatenate(widths) if widths else np.zeros(0)
    return float(np.median(found)) if len(found) else None


def _softness(image: NDArray[np.uint8], mask: NDArray[np.bool_]) -> NDArray[np.floating]:
    """How wide the edge is along some profiles across the outline of `mask`, those of little contrast left out."""
    from scipy.ndimage import map_coordinates

    distance = signed_distance_2d(mask)
    rows, columns = np.nonzero(np.abs(distance) < 1)
    if len(rows) > _PIXELS:
        chosen = np.linspace(0, len(rows) - 1, _PIXELS).astype(int)
        rows, columns = rows[chosen], columns[chosen]
    down, right = np.gradient(distance.astype(np.float32), axis=0), np.gradient(distance.astype(np.float32), axis=1)
    normal = np.stack([down[rows, columns], right[rows, columns]], axis=1)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-6)
    along = np.arange(-_REACH, _REACH + 1)
    places = np.stack([rows, columns], axis=1)[:, None] + along[:, None] * normal[:, None]
    inside = (places >= 0).all(axis=(1, 2)) & (places <= np.array(mask.shape) - 1).all(axis=(1, 2))
    grey = np.asarray(image.astype(np.float32).mean(axis=2))
    profiles = map_coordinates(grey, places[inside].transpose(2, 0, 1), order=1)
    ends = np.abs(np.median(profiles[:, :3], axis=1) - np.median(profiles[:, -3:], axis=1))
    steepest = np.abs(np.diff(profiles, axis=1)).max(axis=1)
    clear = ends >= _CONTRAST
    return ends[clear] / np.maximum(steepest[clear], 1e-6)


def _disagreement(
    silhouettes: Silhouettes, frames: Sequence[int], bounds: Bounds, container: ContainerOcclusion | None
) -> float:
    """Width of the rim of masks that no place along the line of sight explains to the others, pixels: the mean over
    views and frames, as most of an outline may stand still."""
    cameras = silhouettes.cameras
    depths = None
    if container is not None and container.hides:
        depths = [depth_image(container.mesh, camera) for camera in cameras]
    widths = []
    for t in frames:
        inside = [silhouettes.distance(view, t) for view in range(len(cameras))]
        trusted = [view for view in range(len(cameras)) if silhouettes.trusted(view, t)]
        for view in trusted:
            others = [other for other in trusted if other != view]
            if others and (inside[view] < 0).any():
                widths.append(_rim(silhouettes, view, others, inside, bounds, depths))
    return float(np.mean(widths)) if widths else 0.0


def _rim(
    silhouettes: Silhouettes,
    view: int,
    others: Sequence[int],
    inside: Sequence[NDArray[np.float32]],
    bounds: Bounds,
    depths: Sequence[NDArray[np.float32]] | None,
) -> float:
    """Width of the rim of one mask that the `others` do not allow, pixels. inside: signed distances of all views."""
    camera, (x0, y0) = silhouettes.cameras[view], silhouettes.windows[view].corner
    total = 0.0
    for middle, width in _RIMS:
        rows, columns = np.nonzero(np.abs(inside[view] + middle) <= width / 2)
        if len(rows) == 0:
            return total
        if len(rows) > _PIXELS:
            chosen = np.linspace(0, len(rows) - 1, _PIXELS).astype(int)
            rows, columns = rows[chosen], columns[chosen]
        pixels = np.stack([columns + x0 + 0.5, rows + y0 + 0.5], axis=1)
        places, pixel = _lines_of_sight(camera, pixels, bounds)
        allowed = np.asarray(np.isfinite(places).all(axis=2))
        flat = np.where(allowed[..., None], places, 0.0).reshape(-1, 3)
        for other in others:
            seen, depth = silhouettes.cameras[other].project(flat)
            corner = silhouettes.windows[other].corner
            column = np.floor(seen[:, 0] - corner[0]).astype(int)
            row = np.floor(seen[:, 1] - corner[1]).astype(int)
            height, wide = inside[other].shape
            within = (depth > 0) & (column >= 0) & (column < wide) & (row >= 0) & (row < height)
            may = np.zeros(len(flat), dtype=bool)
            may[within] = inside[other][row[within], column[within]] < _BESIDE
            image = silhouettes.cameras[other]
            unseen = (seen[:, 0] < 0) | (seen[:, 0] >= image.width) | (seen[:, 1] < 0) | (seen[:, 1] >= image.height)
            may |= unseen | (depth <= 0)
            if depths is not None:
                may |= hidden(flat, depths[other], image, _BEHIND * pixel)
            allowed = allowed & may.reshape(allowed.shape)
        missing = 1 - allowed.any(axis=1).mean()
        total += width * float(missing)
    return total


def _lines_of_sight(camera: Camera, pixels: NDArray[np.float64], bounds: Bounds) -> tuple[NDArray[np.float64], float]:
    """Places [n, _PLACES, 3] within `bounds` along the lines of sight of `pixels` [n, 2], NaN beyond; and how much a
    pixel spans there, scene units."""
    rays = np.concatenate([pixels, np.ones((len(pixels), 1))], axis=1) @ np.linalg.inv(camera.K).T
    rotation = camera.w2c[:3, :3]
    directions = rays @ rotation
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
    box = bounds.low + corners * (bounds.high - bounds.low)
    along = box @ rotation[2] + camera.w2c[2, 3]
    near, far = max(float(along.min()), 1e-6), float(along.max())
    depths = np.linspace(near, far, _PLACES)
    places = camera.center + depths[:, None] * directions[:, None]
    beyond = ((places < bounds.low) | (places > bounds.high)).any(axis=2)
    places[beyond] = np.nan
    return places, near / focal_length(camera)
