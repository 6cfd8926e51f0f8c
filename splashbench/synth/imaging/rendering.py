"""Images and exact masks of the room and the liquid, by ray casting through the camera's true lens.

The room does not move, so it is cast once per camera (`RoomView`): every sample's depth, and its colour both in light
and in the liquid's shadow. A frame with liquid (`RoomView.with_liquid`) then costs only the rays that can meet the
liquid, and the table's and bowl's samples that can lie in its shadow. Image and masks come from the same samples. A
container of glass (`splashbench.synth.imaging.glass`) hides nothing: it is laid over what lies behind it.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from splashbench.synth.imaging import shading
from splashbench.synth.imaging.geometry import Mesh
from splashbench.synth.imaging.glass import Glass
from splashbench.synth.imaging.lens import LensCamera
from splashbench.synth.imaging.raycast import FAR, Hits, Tracer
from splashbench.synth.imaging.room import CaptureRoom
from splashbench.synth.imaging.texture import sample, to_srgb

Vectors = NDArray[np.float32]

SAMPLES = 3  # per pixel and axis
_OFFSET = np.float32(4e-4)  # metres from a surface at which its shadow rays start
_BEYOND = np.float32(5e-5)  # metres behind one crossing of the liquid's surface at which the next is looked for
_OPENNESS_RAYS = 16
_RIM = 32  # pixels beyond the image from which a surface can still reach into it
# What a view takes of memory for each pixel while it is set up, and what the process has beside it.
_VIEW_PIXEL_BYTES, _PROCESS_BYTES = 750, 400 << 20
_LONGEST_EDGE = 0.006  # metres
_SHADOW_CELL = 0.002  # metres: by squares of this size it is told where shadows may lie
_AT_ONCE = 1 << 19  # samples that are cast at once: all of a large image would take gigabytes
_CROSSINGS = 6  # of the liquid's surface that are followed along a ray through clear liquid


def view_bytes(width: int, height: int) -> int:
    """Memory that a process takes at most which films with a camera of this size in pixels."""
    return _PROCESS_BYTES + width * height * _VIEW_PIXEL_BYTES


@dataclass(frozen=True, eq=False)
class LiquidFrame:
    """A rendered instant: `image` float32 [H, W, 3] sRGB in [0, 1]; `mask` bool [H, W], at least half liquid."""

    image: NDArray[np.float32]
    mask: NDArray[np.bool_]


class TracedRoom:
    """A room that rays can be cast into."""

    def __init__(self, room: CaptureRoom) -> None:
        self.room = room
        meshes = [quad.mesh() for quad in room.quads]
        if room.bowl is not None:
            meshes.append((room.bowl.vertices, room.bowl.faces))
        self.bowl_index = len(room.quads) if room.bowl is not None else -2
        self.tracer = Tracer(meshes)
        self.glass = Glass(room.glass) if room.glass is not None else None

    def surface(self, points: Vectors, hits: Hits) -> tuple[Vectors, Vectors]:
        """Albedo and shading normal [R, 3] at hit points."""
        albedo = np.full((len(points), 3), 0.5, np.float32)
        normal = hits.normal.copy()
        for index in np.unique(hits.geometry):
            chosen = hits.geometry == index
            if index == self.bowl_index:
                albedo[chosen], normal[chosen] = self._bowl_surface(points[chosen], hits, chosen)
            elif index >= 0:
                quad = self.room.quads[index]
                offset = points[chosen] - quad.corner.astype(np.float32)
                u = offset @ (quad.side_u / (quad.side_u @ quad.side_u)).astype(np.float32)
                v = offset @ (quad.side_v / (quad.side_v @ quad.side_v)).astype(np.float32)
                albedo[chosen] = sample(quad.texture, u, v)
        return albedo, normal

    def mirrored(self, points: Vectors, directions: Vectors) -> Vectors:
        """Light [R, 3] that reaches `points` from unit `directions`: from the room, or from what surrounds it."""
        light = self.room.light
        color = shading.surroundings(directions, light)
        hits = self.tracer.nearest(points, directions)
        met = hits.geometry >= 0
        hits = Hits(*(getattr(hits, field.name)[met] for field in fields(hits)))
        reached = points[met] + hits.distance[:, None] * directions[met]
        lit, shaded = shading.matte(*self.surface(reached, hits), light)
        lifted = reached + _OFFSET * hits.normal
        dark = self.tracer.occluded(lifted, np.broadcast_to(light.towards, reached.shape))
        color[met] = np.where(dark[:, None], shaded, lit)
        return color

    def _bowl_surface(self, points: Vectors, hits: Hits, chosen: NDArray[np.bool_]) -> tuple[Vectors, Vectors]:
        bowl, colors, texture = self.room.bowl, self.room.bowl_albedo, self.room.bowl_texture
        assert bowl is not None
        corners = bowl.faces[hits.triangle[chosen]]
        weights = hits.weights[chosen][..., None]
        normal = (bowl.normals[corners] * weights).sum(axis=1)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        away = np.einsum("ij,ij->i", normal, hits.normal[chosen]) < 0
        normal[away] *= -1
        if texture is None:
            assert colors is not None
            return (colors[corners] * weights).sum(axis=1), normal
        azimuth = np.arctan2(points[:, 0], points[:, 2]) / (2 * np.pi) + 0.5
        shape = self.room.bowl_shape
        along = (np.hypot(points[:, 0], points[:, 2]) + points[:, 1]) / (shape.rim_radius + shape.rim_height)
        return sample(texture, azimuth.astype(np.float32), along), normal


class RoomView:
    """A room seen by one camera. Arrays of samples are [P, s * s, ...]: P = H * W pixels, and the samples in each.

    local_rays: the camera's own, of so many samples, where they are known (`LensCamera.local_rays`).
    """

    def __init__(
        self,
        traced: TracedRoom,
        camera: LensCamera,
        samples: int = SAMPLES,
        local_rays: NDArray[np.float64] | None = None,
    ) -> None:
        self.traced, self.camera = traced, camera
        height, width, s = camera.height, camera.width, samples
        by_pixel = camera.rays(s, local_rays).reshape(height, s, width, s, 3).transpose(0, 2, 1, 3, 4)
        self._directions = np.ascontiguousarray(by_pixel).reshape(height * width, s * s, 3)
        self._eye = camera.center.astype(np.float32)
        shape = self._directions.shape
        self._distance, self._lit = np.empty(shape[:2], np.float32), np.empty(shape[:2], np.bool_)
        self._lifted, self._color, self._shade = (np.empty(shape, np.float32) for _ in range(3))
        on_bowl = np.empty(shape[:2], np.bool_)
        step = max(1, _AT_ONCE // (s * s))
        for start in range(0, len(on_bowl), step):
            block = slice(start, start + step)
            seen = self._seen(self._directions[block].reshape(-1, 3), s)
            stored = self._distance, self._lifted, self._lit, on_bowl, self._color, self._shade
            for array, values in zip(stored, seen):
                array[block] = values.reshape(array[block].shape)
        self._on_bowl = on_bowl.any(axis=1)
        color, on_container = self._color, on_bowl
        self._panes = None
        if traced.glass is not None:
            self._panes = traced.glass.along(self._eye, self._directions.reshape(-1, 3))
            color = self._panes.through(color.reshape(-1, 3), 0.0, FAR).reshape(shape)
            on_container = self._panes.met.reshape(shape[:2])
        self.image = to_srgb(_sample_means(color)).reshape(height, width, 3)
        """The room without liquid: float32 [H, W, 3] sRGB in [0, 1]."""
        self.container_mask = (on_container.mean(axis=1) >= 0.5).reshape(height, width)
        """Where the container is seen: bool [H, W]."""

    def _seen(self, directions: Vectors, samples: int) -> tuple[NDArray, ...]:
        """What rays of whole pixels meet: distance, a point just before it, whether the lamp reaches it, whether it is
        the bowl, and its colour in light and in shadow. directions: [R, 3], `samples` squared to each pixel."""
        traced, s = self.traced, samples
        hits = traced.tracer.nearest(self._eye, directions)
        hit = hits.geometry >= 0
        # Beyond the room: a ray that met nothing counts as a far, grey, upright wall.
        reach = np.where(hit, hits.distance, 10).astype(np.float32)
        points = np.asarray(self._eye + reach[:, None] * directions, np.float32)
        albedo, normal = traced.surface(points, hits)
        lifted = points + _OFFSET * hits.normal
        lamp = traced.room.light
        light, shade = shading.matte(albedo, normal, lamp)
        light -= shade
        # The sky changes slowly over a surface: one sample of each pixel speaks for all of them.
        middle = slice(s * s // 2, None, s * s)
        shade *= np.repeat(openness(traced.tracer, lifted[middle]), s * s)[:, None]
        lit = hit & ~traced.tracer.occluded(lifted, np.broadcast_to(lamp.towards, points.shape))
        on_bowl = hits.geometry == traced.bowl_index
        if traced.room.glaze is not None:
            coat, view = traced.room.glaze, directions[on_bowl]
            share = coat.share(normal[on_bowl], view)
            light[on_bowl] = (1 - share) * light[on_bowl] + coat.glint(normal[on_bowl], view, lamp)
            mirrored = traced.mirrored(lifted[on_bowl], shading.mirrored(normal[on_bowl], view))
            shade[on_bowl] = (1 - share) * shade[on_bowl] + share * mirrored
        color = shade + np.where(lit[:, None], light, 0)
        return hits.distance, lifted, lit, on_bowl, color, shade

    def seen_points(self) -> tuple[Vectors, Vectors]:
        """What the pixels that meet the room see: points [N, 3] in the world and their sRGB colours [N, 3]."""
        middle = self._distance.shape[1] // 2
        met = self._distance[:, middle] < FAR
        return self._lifted[met, middle], self.image.reshape(-1, 3)[met]

    def with_liquid(self, liquid: Mesh | None) -> LiquidFrame:
        """The room with this liquid surface in it."""
        mask = np.zeros(self.image.shape[:2], bool)
        if liquid is None or not len(liquid.faces):
            return LiquidFrame(self.image, mask)
        tracer = Tracer([(liquid.vertices, liquid.faces)])
        near = self._pixels_near(liquid.vertices)
        to_light = self.traced.room.light.towards
        on_table = liquid.vertices - to_light * (liquid.vertices[:, 1:2] / to_light[1])
        pixels = np.flatnonzero(near | self._pixels_near(on_table) | self._on_bowl)
        color = self._color[pixels]
        distance = np.full(color.shape[:2], FAR, np.float32)
        seen = np.flatnonzero(near[pixels])
        hits = tracer.nearest(self._eye, self._directions[pixels[seen]].reshape(-1, 3))
        first = hits.distance < self._distance[pixels[seen]].ravel()
        shown = self._lit[pixels]
        if not self.traced.room.clear_liquid:
            shown[seen] &= ~first.reshape(-1, shown.shape[1])  # nobody sees what is behind opaque liquid
        lifted = self._lifted[pixels][shown]
        darkened = _may_lie_in_shadow(liquid.vertices, lifted, to_light)
        lifted = lifted[darkened]
        darkened[darkened] = dark = tracer.occluded(lifted, np.broadcast_to(to_light, lifted.shape))
        shown[shown] = darkened
        color[shown] = self._in_shadow(tracer, lifted[dark], color[shown], self._shade[pixels][shown])
        distance[seen], color[seen] = self._wetted(liquid, tracer, pixels[seen], color[seen], hits, first)
        if self._panes is not None:
            before = self._panes.of(self._samples_of(pixels)).through(color.reshape(-1, 3), 0.0, distance.ravel())
            color = before.reshape(color.shape)
        image = self.image.copy()
        image.reshape(-1, 3)[pixels] = to_srgb(_sample_means(color))
        mask.ravel()[pixels] = (distance < FAR).mean(axis=1) >= 0.5
        return LiquidFrame(image, mask)

    def _in_shadow(self, tracer: Tracer, points: Vectors, color: Vectors, shade: Vectors) -> Vectors:
        """The room's colour [R, 3] where liquid stands between `points` and the key light: `color` if it did not."""
        dye = self.traced.room.dye
        if not dye.tints_shadow:
            return shade
        depth = depth_above(tracer, points, np.broadcast_to(self.traced.room.light.towards, points.shape))
        return np.asarray(shade + (color - shade) * np.exp(-dye.absorption * depth[:, None]), np.float32)

    def _wetted(
        self,
        liquid: Mesh,
        tracer: Tracer,
        pixels: NDArray[np.int_],
        color: Vectors,
        hits: Hits,
        first: NDArray[np.bool_],
    ) -> tuple[NDArray[np.float32], Vectors]:
        """How far the liquid is where samples of `pixels` see it before the room (FAR elsewhere), and its colour there.

        hits: of these samples with the liquid; first: which of them come before the room. Glass before the liquid is
        left out; where no liquid is seen, `color` stays.
        """
        view = self._directions[pixels].reshape(-1, 3)[first]
        points = self._eye + hits.distance[first, None] * view
        corners, weights = liquid.faces[hits.triangle[first]], hits.weights[first]
        normal = sum(liquid.normals[corners[:, k]] * weights[:, k : k + 1] for k in range(3))
        normal /= np.linalg.norm(normal, axis=1, keepdims=True) + np.float32(1e-9)
        lifted = points + _OFFSET * hits.normal[first]
        room = self.traced.room
        towards = np.broadcast_to(room.light.towards, points.shape)
        lit = ~tracer.occluded(lifted, towards)
        lit[lit] = ~self.traced.tracer.occluded(lifted[lit], towards[lit])
        wet = first.reshape(color.shape[:2])
        alone = np.ones(len(points), np.float32)
        openness = shading.bowl_openness(points, room.bowl_shape) if room.bowl is not None else alone
        behind = None
        if room.clear_liquid:
            light = color[wet]
            if self._panes is not None:
                panes = self._panes.of(self._samples_of(pixels)[first])
                light = panes.through(light, hits.distance[first], FAR)
            reach = self._distance[pixels].ravel()[first] - hits.distance[first]
            behind = shading.Behind(light, thickness(tracer, points, view, reach))
        color[wet] = shading.wet(normal, view, lit, openness, behind, room.dye, room.light)
        return np.where(first, hits.distance, FAR).reshape(wet.shape), color

    def _samples_of(self, pixels: NDArray[np.int_]) -> NDArray[np.int_]:
        """Indices into all samples, in the order of `pixels`."""
        per_pixel = self._distance.shape[1]
        return (pixels[:, None] * per_pixel + np.arange(per_pixel)).ravel()

    def _pixels_near(self, points: Vectors) -> NDArray[np.bool_]:
        """Which pixels [P] lie within a triangle's reach of any of these surface points."""
        import cv2

        height, width = self.image.shape[:2]
        uv, depth = self.camera.project(points.astype(np.float64))
        at = np.floor(uv).astype(np.int64)
        inside = (depth > 0) & (at >= -_RIM).all(axis=1) & (at < np.array([width, height]) + _RIM).all(axis=1)
        marked = np.zeros((height + 2 * _RIM, width + 2 * _RIM), np.uint8)
        marked[at[inside, 1] + _RIM, at[inside, 0] + _RIM] = 1
        # No edge of the surface is longer than this in space (marching cubes), so none spans more pixels than that.
        reach = int(np.ceil(_LONGEST_EDGE * self.camera.K[0, 0] / max(0.2, float(depth.min(initial=1.0))))) + 1
        kernel = np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)
        grown = cv2.dilate(marked, kernel)
        return grown[_RIM:-_RIM, _RIM:-_RIM].astype(bool).ravel()


def _may_lie_in_shadow(vertices: Vectors, points: Vectors, to_light: Vectors) -> NDArray[np.bool_]:
    """Which of `points` [R, 3] have a part of a liquid surface of these vertices [V, 3] near their line to the light,
    so that it may stand before it: along all others there is none."""
    import cv2

    light = to_light.astype(np.float64)
    across = np.cross(light, [1.0, 0.0, 0.0] if abs(light[0]) < 0.9 else [0.0, 1.0, 0.0])
    axes = np.stack([across, np.cross(light, across)]).T / np.linalg.norm(across) / np.linalg.norm(light)
    flat = vertices.astype(np.float64) @ axes
    reach = int(np.ceil(_LONGEST_EDGE / _SHADOW_CELL)) + 1
    low = flat.min(axis=0) - (reach + 1) * _SHADOW_CELL
    sides = np.ceil((flat.max(axis=0) - low) / _SHADOW_CELL).astype(np.int64) + reach + 2
    marked = np.zeros(sides, np.uint8)
    at = ((flat - low) / _SHADOW_CELL).astype(np.int64)
    marked[at[:, 0], at[:, 1]] = 1
    # No edge of the surface is longer than _LONGEST_EDGE, so that none lies farther from all vertices.
    grown = cv2.dilate(marked, np.ones((2 * reach + 1, 2 * reach + 1), np.uint8))
    place = np.floor((points.astype(np.float64) @ axes - low) / _SHADOW_CELL)
    within = ((place >= 0) & (place < sides)).all(axis=1)
    found = np.zeros(len(points), bool)
    column, row = place[within].astype(np.int64).T
    found[within] = grown[column, row] > 0
    return found


def _sample_means(values: Vectors) -> Vectors:
    """Means over each pixel's samples: [P, S, 3] to [P, 3]."""
    total = values[:, 0].copy()
    for k in range(1, values.shape[1]):
        total += values[:, k]
    return np.asarray(total / values.shape[1], np.float32)


def thickness(tracer: Tracer, points: Vectors, directions: Vectors, reach: NDArray[np.float32]) -> NDArray[np.float32]:
    """Metres of liquid [R] along rays that enter it at `points` [R, 3] and end `reach` [R] metres later."""
    total, travelled = np.zeros(len(points), np.float32), np.zeros(len(points), np.float32)
    rays, inside = np.arange(len(points)), True
    for _ in range(_CROSSINGS):
        start = travelled[rays] + _BEYOND
        hits = tracer.nearest(points[rays] + start[:, None] * directions[rays], directions[rays])
        on = hits.geometry >= 0
        rays, crossing = rays[on], (start + hits.distance)[on]
        if inside:
            total[rays] += np.maximum(np.minimum(crossing, reach[rays]) - travelled[rays], 0)
        travelled[rays], inside = crossing, not inside
    return total


def depth_above(tracer: Tracer, points: Vectors, directions: Vectors) -> NDArray[np.float32]:
    """Metres of liquid [R] along rays from `points` [R, 3] that end outside it; they may begin inside or outside."""
    travelled = np.zeros(len(points), np.float32)
    rays, total, crossings = np.arange(len(points)), np.zeros(len(points), np.float32), np.zeros(len(points), int)
    for k in range(_CROSSINGS):
        start = travelled[rays] + _BEYOND
        hits = tracer.nearest(points[rays] + start[:, None] * directions[rays], directions[rays])
        on = hits.geometry >= 0
        rays = rays[on]
        travelled[rays] = (start + hits.distance)[on]
        # Summed with alternating signs; the last crossing leads out of the liquid, so it counts as positive.
        total[rays] += np.float32((-1) ** k) * travelled[rays]
        crossings[rays] += 1
    return np.where(crossings % 2 == 1, total, -total)


def openness(tracer: Tracer, points: Vectors) -> NDArray[np.float32]:
    """Share [R] of the sky that points see, by a fixed fan of upward rays: ambient occlusion, never below 0.4."""
    seen = np.zeros(len(points), np.float32)
    for k in range(_OPENNESS_RAYS):
        azimuth, elevation = 2.4 * k, np.radians(20 + 60 * (k + 0.5) / _OPENNESS_RAYS)
        direction = np.array(
            [np.cos(azimuth) * np.cos(elevation), np.sin(elevation), np.sin(azimuth) * np.cos(elevation)], np.float32
        )
        seen += ~tracer.occluded(points, np.broadcast_to(direction, points.shape))
    return (0.4 + 0.6 * seen / _OPENNESS_RAYS).astype(np.float32)
