"""A stage: the scene nodes of one exhibit on one viser server, layer by layer."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from threading import RLock
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splashbench.export.surface import surface_mesh
from splashbench.scene import Gaussians, SignedDistance
from splashbench.submission import to_8bit
from splashbench.viewer.camera_layer import CameraLayer
from splashbench.viewer.coloring import PLAIN, colors_of
from splashbench.viewer.cut_layer import CutLayer
from splashbench.viewer.cuts import cut
from splashbench.viewer.exhibit import Exhibit, Extent
from splashbench.viewer.geometry import quaternion, turned_to
from splashbench.viewer.layers import FixedLayer, Job, Layer, Moment, TimedLayer
from splashbench.viewer.merging import Lookout, merged
from splashbench.viewer.pictures import PictureLayer
from splashbench.viewer.splat_layer import SplatLayer
from splashbench.viewer.splats import pack, sound, unit_of
from splashbench.viewer.units import length_text, round_down

#: Gaussians of a background, at the most.
MOST_BACKGROUND = 200_000
#: Arrows of a timestep, at the most.
MOST_ARROWS = 500
# Triangles of the surface, all timesteps together: what a browser holds besides the rest.
_MOST_FACES = 4_000_000
# Nodes of the grid that it is made from.
_MOST_NODES = 16_000_000
# The longest arrows (95th percentile of the first timestep) as a share of the liquid's extent.
_ARROW = 0.08
# How far before a camera its photograph hangs, as a share of the way to the liquid.
_FRUSTUM = 0.16
_LIQUID_COLOR, _CONTAINER_COLOR = (70, 130, 210), (170, 170, 175)


@dataclass(frozen=True)
class Settings:
    """How layers are drawn: particles coloured by `measure` (one of MEASURES, or "none"); the cut through the signed
    distance across `axis` (0 to 2) at `share` in [0, 1] of the grid."""

    measure: str = "speed"
    axis: int = 2
    share: float = 0.5


class Stage:
    """The layers of `exhibit` on `server`, under a node of their own.

    Args:
        server: viser's. root: that node's name.
        clicked: called with client and camera name when somebody clicks a camera.
        lookout: from where it is looked at, at first. extent: of what is looked at, one for both halves.
    """

    def __init__(
        self,
        server: Any,
        exhibit: Exhibit,
        root: str,
        clicked: Callable[[Any, str], None],
        lookout: Lookout,
        extent: Extent,
    ) -> None:
        self.exhibit, self.settings = exhibit, Settings(axis=_facing(exhibit))
        self._lookout, self._extent = lookout, extent
        self._server, self._root, self._scene = server, root, server.scene
        self._frame = self._scene.add_frame(root, show_axes=False)
        self._lock = RLock()
        self._moment = Moment(0, False)
        self._stride: int | None = None
        self._arrow_seconds: float | None = None
        self._background_left_out = 0
        # The colour of what is behind everything, and the picture of it while that is shown.
        self._ground_color: NDArray[np.uint8] | None = None
        self._ground: NDArray[np.uint8] | None = None
        self.layers: dict[str, Layer] = {layer.name: layer for layer in self._make_layers(clicked)}

    # What there is of an exhibit is known from its opening; a layer that then finds nothing says so.
    def _make_layers(self, clicked: Callable[[Any, str], None]) -> list[Layer]:
        shown, lock = self.exhibit, self._lock
        middle, frames = self._extent.middle, shown.n_frames
        layers: list[Layer] = []
        if shown.has_gaussians:
            layers.append(
                SplatLayer(
                    self._scene,
                    f"{self._root}/liquid",
                    lock,
                    self._server.atomic,
                    shown.gaussians,
                    frames,
                    self._lookout,
                    middle,
                )
            )
        if shown.has_background:
            layers.append(FixedLayer("background", "background", lock, self._background, True, self._background_remark))
        if shown.has_points:
            layers.append(FixedLayer("points", "sparse points", lock, self._static_points, True))
        if shown.has_particles:
            # Where there is something to look at instead, thousands of points stand in its way.
            on = not (shown.has_gaussians or shown.has_picture)
            layers.append(TimedLayer("particles", shown.particles_title, lock, self._particles, frames, on))
        if shown.has_distance:
            on = not (shown.has_gaussians or shown.has_picture or shown.has_particles)
            layers.append(
                TimedLayer("surface", shown.surface_title, lock, self._surface, frames, on, self._surface_remark)
            )
            layers.append(CutLayer("cut", "cut of the distance", lock, self._cut))
        if shown.has_velocity or shown.has_particles:
            layers.append(TimedLayer("velocity", "velocity", lock, self._arrows, frames, remark=self._arrow_remark))
        if shown.has_picture:
            layers.append(
                PictureLayer(
                    lock, self._server.get_clients, shown.picture, lambda: self._ground, not shown.has_gaussians
                )
            )
        if shown.has_container:
            layers.append(FixedLayer("container", "container", lock, self._container, True))
        layers.append(
            CameraLayer(
                self._scene,
                f"{self._root}/cameras",
                lock,
                shown.cameras,
                shown.train,
                shown.photograph,
                frames,
                _FRUSTUM * float(np.median([np.linalg.norm(c.center - middle) for c in shown.cameras.values()])),
                clicked,
            )
        )
        layers.append(FixedLayer("grid", "ground grid", lock, self._grid, True))
        return layers

    @property
    def moment(self) -> Moment:
        """What is shown."""
        return self._moment

    def show(self, moment: Moment) -> None:
        """Show `moment` in every layer, all at once."""
        with self._lock, self._server.atomic():
            self._moment = moment
            for layer in self.layers.values():
                layer.show(moment)

    def set_visible(self, visible: bool) -> None:
        """Show or hide all of it."""
        self._frame.visible = visible
        picture = self.layers.get("picture")
        if isinstance(picture, PictureLayer) and not visible:
            picture.clear()  # it stands under no node
        self._show_ground(visible)

    def _show_ground(self, visible: bool) -> None:
        """Show what is behind everything where the background is, as it has gaps."""
        with self._lock:
            background = self.layers.get("background")
            shown = visible and background is not None and background.on and self._ground_color is not None
            ground = self._ground_color[None, None] if shown and self._ground_color is not None else None
            if (ground is None) != (self._ground is None):
                self._ground = ground
                self._scene.set_background_image(ground, format="png")

    def switch(self, name: str, on: bool) -> None:
        """Show or hide the layer `name`, where there is one."""
        if name in self.layers:
            with self._lock:
                self.layers[name].switch(on, self._moment)
                self._show_ground(self._frame.visible)

    def fail(self, layer: Layer, fault: str) -> None:
        """Take `layer` out, because of `fault`."""
        with self._lock:
            layer.fail(fault, self._moment)
            self._show_ground(self._frame.visible)

    def look_through(self, looks: bool) -> None:
        """Whether somebody looks through one of the cameras."""
        layer = self.layers["cameras"]
        assert isinstance(layer, CameraLayer)
        layer.look_through(looks)

    def look_from(self, lookout: Lookout) -> None:
        """Clients look from `lookout` now, and stay there for a while."""
        layer = self.layers.get("liquid")
        if isinstance(layer, SplatLayer):
            layer.look_from(lookout)

    def send_ahead(self, ahead: bool) -> None:
        """Send the liquid's Gaussians of all timesteps, or of the one that is shown."""
        layer = self.layers.get("liquid")
        if isinstance(layer, SplatLayer) and layer.send_ahead != ahead:
            with self._lock:
                layer.set_send_ahead(ahead, self._moment)

    def set(self, **changes: Any) -> None:
        """Change `settings`, and make anew what depends on them."""
        with self._lock:
            before, self.settings = self.settings, replace(self.settings, **changes)
            touched = ["particles"] if before.measure != self.settings.measure else []
            touched += ["cut"] if (before.axis, before.share) != (self.settings.axis, self.settings.share) else []
            for name in touched:
                if name in self.layers:
                    self.layers[name].settings_changed()
            self.show(self._moment)

    def jobs(self, urgent: bool) -> list[tuple[Layer, Job]]:
        """What is missing for what is shown (`urgent`), or could be made ahead, layer by layer."""
        with self._lock:
            asked = [(layer, (layer.urgent if urgent else layer.ahead)(self._moment)) for layer in self.layers.values()]
            return [(layer, job) for layer, job in asked if job is not None]

    def done(self) -> None:
        """Show what a job has made."""
        with self._lock:  # else the clock's thread may go on between the look at the moment and its being shown
            self.show(self._moment)
            self._show_ground(self._frame.visible)

    def remarks(self) -> list[str]:
        """Sentences on what is shown coarser than it is, and on what cannot be shown."""
        said = [layer.remark for layer in self.layers.values()]
        said += [self.exhibit.coarse] if self._shows_coarse else []
        said += [
            f"The layer {layer.title} cannot be shown: {layer.fault}" for layer in self.layers.values() if layer.fault
        ]
        return [sentence for sentence in said if sentence]

    @property
    def _shows_coarse(self) -> bool:
        return any(name in self.layers and self.layers[name].on for name in ("particles", "surface", "cut"))

    # The nodes of each layer.

    def _background(self) -> list[Any]:
        self._ground_color = self.exhibit.ground()
        gaussians = self.exhibit.static_gaussians()
        gaussians = Gaussians.none() if gaussians is None else sound(gaussians)
        if not len(gaussians):
            return []
        packed = pack(merged(gaussians, self._lookout), unit_of(gaussians), MOST_BACKGROUND)
        self._background_left_out = packed.left_out
        name = f"{self._root}/background"
        return [self._scene.add_gaussian_splats(name, scale=packed.scale, visible=False, **packed.arguments())]

    def _background_remark(self) -> str:
        left_out = self._background_left_out
        return (
            f"{MOST_BACKGROUND} of the background's {MOST_BACKGROUND + left_out} Gaussians are shown."
            if left_out
            else ""
        )

    def _static_points(self) -> list[Any]:
        points = self.exhibit.static_points()
        if points is None or not len(points):
            return []
        return [self._points("points", points[:, :3], to_8bit(points[:, 3:6]), 0.006)]

    def _points(self, name: str, positions: NDArray, colors: NDArray[np.uint8], share: float) -> Any:
        return self._scene.add_point_cloud(
            f"{self._root}/{name}",
            points=np.asarray(positions, np.float32),
            colors=colors,
            point_size=share * self._extent.size,
            point_shape="circle",
            precision="float32",
            visible=False,
        )

    def _particles(self, t: int) -> Any:
        tracks = self.exhibit.tracks
        if tracks is None or not len(tracks.positions[t]):
            return None
        return self._points(f"particles/timestep {t}", tracks.positions[t], self._particle_colors(t), 0.01)

    def _particle_colors(self, t: int) -> NDArray[np.uint8]:
        tracks, measure, up = self.exhibit.tracks, self.settings.measure, self.exhibit.up
        assert tracks is not None
        if measure == "none":
            return np.tile(np.array(PLAIN, np.uint8), (len(tracks.positions[t]), 1))
        return colors_of(tracks.values(measure, t, up), tracks.span(measure, up))

    def _surface(self, t: int) -> Any:
        distance = self.exhibit.distance(t)
        if distance is None:
            return None
        # A grid of a stranger's may have any number of nodes.
        least = math.ceil((distance.phi[0].size / _MOST_NODES) ** (1 / 3))
        mesh = surface_mesh(coarser(distance, max(self._stride or 1, least)))
        if not len(mesh.faces):
            return None
        most = _MOST_FACES / self.exhibit.n_frames
        if self._stride is None:
            # Triangles grow as the square of the nodes along a side.
            self._stride = least * max(1, math.ceil(math.sqrt(len(mesh.faces) / most)))
            mesh = surface_mesh(coarser(distance, self._stride)) if self._stride > least else mesh
        return self._mesh(f"surface/timestep {t}", mesh.vertices, mesh.faces, _LIQUID_COLOR, 0.85)

    def _surface_remark(self) -> str:
        return (
            f"The surface is made from one node in {self._stride} along each axis." if (self._stride or 1) > 1 else ""
        )

    def _mesh(self, name: str, vertices: NDArray, faces: NDArray, color: tuple[int, int, int], opacity: float) -> Any:
        return self._scene.add_mesh_simple(
            f"{self._root}/{name}",
            vertices=np.asarray(vertices, np.float32),
            faces=np.asarray(faces, np.uint32),
            color=color,
            opacity=opacity,
            side="double",
            visible=False,
            cast_shadow=False,
            receive_shadow=False,
        )

    def _container(self) -> list[Any]:
        mesh = self.exhibit.container()
        return [] if mesh is None else [self._mesh("container", mesh.vertices, mesh.faces, _CONTAINER_COLOR, 0.35)]

    def _motion(self, t: int) -> tuple[NDArray, NDArray] | None:
        """Places [N, 3] and velocities [N, 3] of timestep `t`: the method's field, else those of its particles."""
        field = self.exhibit.velocity(t)
        if field is not None:
            nodes = np.argwhere(field.liquid)
            return field.origin + nodes * field.spacing, field.values[field.liquid]
        tracks = self.exhibit.tracks
        if tracks is None:
            return None
        known = np.isfinite(tracks.velocities[t]).all(axis=1)
        return tracks.positions[t][known], tracks.velocities[t][known]

    def _arrows(self, t: int) -> Any:
        motion = self._motion(t)
        if motion is None or not len(motion[0]):
            return None
        rows = slice(None, None, max(1, -(-len(motion[0]) // MOST_ARROWS)))
        places, velocities = motion[0][rows], motion[1][rows]
        speeds = np.linalg.norm(velocities, axis=1)
        fast = float(np.percentile(speeds, 95))
        size = self._extent.size
        if self._arrow_seconds is None and fast > 0:
            self._arrow_seconds = round_down(_ARROW * size / fast)
        ends = places + velocities * (self._arrow_seconds or 0.0)
        tracks, up = self.exhibit.tracks, self.exhibit.up
        span = tracks.span("speed", up) if tracks is not None and tracks.has("speed") else (0.0, fast or 1.0)
        return self._scene.add_arrows(
            f"{self._root}/velocity/timestep {t}",
            points=np.stack([places, ends], axis=1).astype(np.float32),
            colors=colors_of(speeds, span),
            shaft_radius=0.0015 * size,
            head_radius=0.004 * size,
            head_length=0.01 * size,
            visible=False,
        )

    def _arrow_remark(self) -> str:
        seconds = self._arrow_seconds
        return "" if seconds is None else f"An arrow is as long as the way of {seconds:g} s."

    def _cut(self, moment: Moment) -> Any:
        distance = self.exhibit.distance(moment.t)
        if distance is None:
            return None
        made = cut(distance, self.settings.axis, self.settings.share)
        return self._scene.add_image(
            f"{self._root}/cut",
            made.image,
            render_width=made.width,
            render_height=made.height,
            format="png",
            wxyz=quaternion(np.stack([made.right, made.down, np.cross(made.right, made.down)], axis=1)),
            position=made.center,
            cast_shadow=False,
            receive_shadow=False,
            visible=False,
        )

    def _grid(self) -> list[Any]:
        shown = self.exhibit
        extent, up = self._extent, shown.up
        cell = round_down(extent.size / 5)
        corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
        heights = (extent.low + corners * (extent.high - extent.low)) @ up
        ground = extent.middle - (extent.middle @ up - heights.min()) * up
        axes = turned_to(up)
        side = 12 * cell
        grid = self._scene.add_grid(
            f"{self._root}/grid",
            width=side,
            height=side,
            cell_size=cell,
            section_size=side,
            wxyz=quaternion(axes),
            position=ground,
            shadow_opacity=0.0,
            visible=False,
        )
        label = self._scene.add_label(
            f"{self._root}/grid size",
            f"grid: {length_text(cell, shown.metres_per_unit)}",
            position=ground - 0.5 * side * axes[:, 0] - 0.5 * side * axes[:, 1],
            font_screen_scale=0.8,
            visible=False,
        )
        return [grid, label]


def _facing(exhibit: Exhibit) -> int:
    """The axis across which a cut stands upright and faces the cameras."""
    towards = exhibit.eye - exhibit.extent.middle
    level = towards - (towards @ exhibit.up) * exhibit.up
    return int(np.abs(level).argmax())


def coarser(distance: SignedDistance, stride: int) -> SignedDistance:
    """`distance` at every `stride`-th node; it stays in parts of the finer voxel, and is 0 where it was."""
    if stride == 1:
        return distance
    return SignedDistance(distance.phi[:, ::stride, ::stride, ::stride], distance.origin, distance.voxel * stride)
