"""What is looked at: a scene or a submission, as the viewer's layers ask for it.

At opening a submission's model is asked what it has, and where its liquid is. The rest is asked for by timestep and
made when asked for: the viewer does so on one thread, apart from its clock.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from splashbench.errors import SplashbenchError, one_line
from splashbench.export.backdrop import backdrop_color
from splashbench.observe import Grid, Silhouettes, sequence_bounds, signed_distance_frames
from splashbench.replay import Reconstruction, load
from splashbench.scene import Camera, ContainerMesh, Gaussians, Particles, Scene, SignedDistance, VelocityField
from splashbench.submission import IDENTITY, to_8bit
from splashbench.viewer.tracks import Tracks

#: Cells of a scene's visual hull along its longest side: coarse, so that a timestep takes a fraction of a second.
HULL_CELLS = 64
#: Particles shown in a timestep, at the most.
MOST_PARTICLES = 20_000
# Share of the distances of particles to their middle that is within the extent.
_MOST_OF_IT = 98.0
# Of cameras that look at one scene: how far two exhibits' may be apart, as a share of the rig's size.
_SAME_RIG = 0.1


@dataclass(frozen=True)
class Extent:
    """Where the liquid is, about: a box between `low` and `high` [3], scene units."""

    low: NDArray[np.float64]
    high: NDArray[np.float64]

    @property
    def middle(self) -> NDArray[np.float64]:
        """The box's middle [3]."""
        return 0.5 * (self.low + self.high)

    @property
    def size(self) -> float:
        """The box's longest side."""
        return float((self.high - self.low).max())


class Exhibit(ABC):
    """What is looked at.

    Attributes:
        name: for people. place: its folder.
        times: [T] seconds. real_times: whether they are seconds, or an order alone.
        cameras: name -> Camera, training cameras first. train: names of those.
        gravity: unit vector [3] or None. metres_per_unit: number or None.
        has_gaussians, has_background, has_points, has_particles, has_distance, has_velocity, has_container,
            has_picture: what there is of it, known from the opening.
        particles_title, surface_title: what its particles and its surface are, for people.
    """

    name: str
    place: Path
    times: NDArray[np.float64]
    real_times: bool
    cameras: dict[str, Camera]
    train: tuple[str, ...]
    gravity: NDArray[np.float64] | None
    metres_per_unit: float | None
    has_gaussians = has_background = has_points = has_particles = has_distance = has_velocity = False
    has_container = has_picture = False
    particles_title, surface_title = "particles", "surface"

    @property
    def n_frames(self) -> int:
        """T, the number of timesteps."""
        return len(self.times)

    def camera(self, name: str) -> Camera:
        """The camera `name`. Raises SplashbenchError where there is none."""
        if name not in self.cameras:
            raise SplashbenchError(f"{self.place} has no camera {name[:40]!r}; choose one of {', '.join(self.cameras)}")
        return self.cameras[name]

    def nearest(self, time: float) -> int:
        """The timestep nearest to `time` seconds."""
        return int(np.abs(self.times - time).argmin())

    @cached_property
    def up(self) -> NDArray[np.float64]:
        """Unit vector [3]: against gravity where that is known, else the mean of the cameras' up."""
        up = sum((-camera.w2c[1, :3] for camera in self.cameras.values()), np.zeros(3))
        if self.gravity is not None and np.linalg.norm(self.gravity) > 0:
            up = -np.asarray(self.gravity, dtype=np.float64)
        size = float(np.linalg.norm(up))
        return np.asarray(up / size) if size > 1e-9 else np.array([0.0, 0.0, 1.0])

    @property
    def eye(self) -> NDArray[np.float64]:
        """The mean place of the training cameras [3], from where Gaussians are coloured."""
        return np.asarray(np.mean([self.cameras[name].center for name in self.train or self.cameras], axis=0))

    @cached_property
    def extent(self) -> Extent:
        """Where the liquid is, about."""
        points = self._some_points()
        points = None if points is None else points[np.isfinite(points).all(axis=1)]
        if points is not None and len(points):
            low, high = np.percentile(points, [100 - _MOST_OF_IT, _MOST_OF_IT], axis=0)
            if (high - low).max() > 0:
                return Extent(np.asarray(low, np.float64), np.asarray(high, np.float64))
        return self._seen_extent()

    def _seen_extent(self) -> Extent:
        """A box at the point nearest to all optical axes, a quarter as large as the cameras are away."""
        normal, right = np.zeros((3, 3)), np.zeros(3)
        for camera in self.cameras.values():
            across = np.eye(3) - np.outer(camera.w2c[2, :3], camera.w2c[2, :3])
            normal += across
            right += across @ camera.center
        middle = np.asarray(np.linalg.lstsq(normal, right, rcond=None)[0], dtype=np.float64)
        distance = float(np.median([np.linalg.norm(camera.center - middle) for camera in self.cameras.values()]))
        half = np.full(3, max(0.125 * distance, 1e-6))
        return Extent(middle - half, middle + half)

    @abstractmethod
    def _some_points(self) -> NDArray | None:
        """Places [N, 3] of liquid, or None where none are known without much work."""

    @abstractmethod
    def photograph(self, camera: str, t: int) -> NDArray[np.uint8] | None:
        """sRGB uint8 [H, W, 3] of `camera` at timestep `t`, or None."""

    @abstractmethod
    def container(self) -> ContainerMesh | None:
        """The container, or None."""

    @abstractmethod
    def distance(self, t: int) -> SignedDistance | None:
        """The liquid's signed distance at timestep `t` alone, or None."""

    @abstractmethod
    def _particles(self) -> Particles | None:
        """The liquid's particles, or None."""

    def gaussians(self, t: int) -> Gaussians | None:
        """The liquid's Gaussians at timestep `t`, or None for what has none."""
        return None

    def static_gaussians(self) -> Gaussians | None:
        """The background's Gaussians, or None."""
        return None

    def ground(self) -> NDArray[np.uint8] | None:
        """The colour [3] that is seen where there is no Gaussian, uint8 sRGB; None where that is not known."""
        return None

    def static_points(self) -> NDArray[np.float32] | None:
        """Points [N, 6] of what stands still: x, y, z in scene units, r, g, b in [0, 1]; or None."""
        return None

    def velocity(self, t: int) -> VelocityField | None:
        """The liquid's velocity at timestep `t`, or None."""
        return None

    def picture(self, camera: Camera, t: int) -> NDArray[np.uint8] | None:
        """What `camera` sees by the method's own renderer, uint8 [H, W, 3]; None for what cannot be rendered."""
        return None

    @cached_property
    def tracks(self) -> Tracks | None:
        """The particles as they are shown, or None. Raises SplashbenchError for other numbers of timesteps."""
        particles = self._particles()
        if particles is None:
            return None
        if particles.n_frames != self.n_frames:
            raise SplashbenchError(
                f"{self.place} has particles of {particles.n_frames} timesteps, and {self.n_frames} times"
            )
        return Tracks.of(particles, self.times, MOST_PARTICLES)

    @property
    def coarse(self) -> str:
        """A sentence on what is shown coarser than it is; empty where nothing is."""
        return ""


class SceneExhibit(Exhibit):
    """A scene: photographs, true particles where it is synthetic, and the visual hull of its masks."""

    has_distance = True
    particles_title, surface_title = "true particles", "visual hull"

    def __init__(self, scene: Scene) -> None:
        self.scene, self.place, self.name = scene, scene.directory, f"scene {scene.name}"
        self.times, self.real_times = scene.times, scene.times_source != "nominal"
        self.cameras, self.train = scene.cameras, scene.train
        self.gravity, self.metres_per_unit = scene.gravity, scene.metres_per_unit
        self.has_points = scene.initial_points() is not None
        self.has_particles, self.has_container = scene.has_truth, _has_mesh(scene)

    def _some_points(self) -> NDArray | None:
        tracks = self.tracks
        if tracks is not None and any(map(len, tracks.positions)):
            return np.concatenate(tracks.positions)
        return None

    def photograph(self, camera: str, t: int) -> NDArray[np.uint8]:
        """The scene's, of test cameras too."""
        return self.scene.image(camera, t)

    def container(self) -> ContainerMesh | None:
        """The scene's."""
        return self.scene.container_mesh()

    def _particles(self) -> Particles | None:
        return self.scene.truth_particles()

    def static_points(self) -> NDArray[np.float32] | None:
        """The scene's initial points."""
        points = self.scene.initial_points()
        return None if points is None else points[:, :6]

    @cached_property
    def _hull(self) -> tuple[Silhouettes, Grid]:
        silhouettes = Silhouettes(self.scene)
        return silhouettes, Grid.over(sequence_bounds(silhouettes, tight=False).padded(0.1), HULL_CELLS)

    def distance(self, t: int) -> SignedDistance:
        """The visual hull's, by the training masks alone. The first one reads every mask, which takes a while."""
        silhouettes, grid = self._hull
        (phi,) = signed_distance_frames(silhouettes, grid, frames=[t])
        return SignedDistance.of(phi[None], grid.origin, grid.voxel)

    @property
    def coarse(self) -> str:
        """Of the hull, and of particles."""
        return (
            f"The hull and its cuts are coarse: {HULL_CELLS} cells along the longest side, from the training masks "
            f"alone.{_left_out(self)}"
        )


class SubmissionExhibit(Exhibit):
    """A submission: what its method's model and files hold."""

    def __init__(self, reconstruction: Reconstruction) -> None:
        self.reconstruction = made = reconstruction
        identity = made.submission.identity
        self.place, self.name = made.submission.directory, f"{identity.method} ({identity.preset})"
        self.times, self.cameras, self.train = made.times, made.cameras, made.train
        self.real_times = made.times_source != "nominal"
        self.gravity, self.metres_per_unit = made.gravity, made.metres_per_unit
        self.has_gaussians, self.has_picture = self.gaussians(0) is not None, made.has_model
        self.has_background = self.static_gaussians() is not None
        self.has_velocity = self.velocity(0) is not None
        self.has_particles = (self.place / "particles.npz").is_file()
        self.has_distance = (
            made.fitted.surface(float(self.times[0])) is not None or (self.place / "geometry.npz").is_file()
        )
        self.has_container = made.scene is not None and _has_mesh(made.scene)

    def _some_points(self) -> NDArray | None:
        for t in (self.n_frames // 2, self.n_frames - 1):
            gaussians = self.gaussians(t)
            if gaussians is not None and len(gaussians):
                return gaussians.means
        tracks = self.tracks
        if tracks is not None and any(map(len, tracks.positions)):
            return np.concatenate(tracks.positions)
        return None

    def photograph(self, camera: str, t: int) -> NDArray[np.uint8] | None:
        """Of the scene, where it was given."""
        scene = self.reconstruction.scene
        if scene is None:
            return None
        # The method may have seen fewer timesteps than the scene has.
        return scene.image(camera, int(np.abs(scene.times - self.times[t]).argmin()))

    def container(self) -> ContainerMesh | None:
        """Of the scene, where it was given and has one."""
        scene = self.reconstruction.scene
        return None if scene is None else scene.container_mesh()

    def _particles(self) -> Particles | None:
        return self.reconstruction.particles()

    def gaussians(self, t: int) -> Gaussians | None:
        """The method's, coloured as seen from the training cameras' mean place."""
        return self.reconstruction.gaussians(float(self.times[t]), self.eye)

    def static_gaussians(self) -> Gaussians | None:
        """The method's background, where it keeps one apart."""
        return self.reconstruction.static_gaussians(self.eye)

    def ground(self) -> NDArray[np.uint8] | None:
        """The colour that the method shows through the gaps of its background."""
        color = backdrop_color(self.reconstruction)
        return None if color is None else to_8bit(color)

    def distance(self, t: int) -> SignedDistance | None:
        """The method's."""
        return self.reconstruction.surface(float(self.times[t]))

    def velocity(self, t: int) -> VelocityField | None:
        """The method's."""
        return self.reconstruction.velocity(float(self.times[t]))

    def picture(self, camera: Camera, t: int) -> NDArray[np.uint8] | None:
        """By the method's own renderer; None where no model is kept."""
        if not self.reconstruction.has_model:
            return None
        rgb = self.reconstruction.render(camera, float(self.times[t])).rgb
        return to_8bit(np.nan_to_num(rgb))

    @property
    def coarse(self) -> str:
        """Of particles."""
        return _left_out(self).strip()


def _has_mesh(scene: Scene) -> bool:
    return scene.meta is not None and scene.meta.container_mesh is not None


def _left_out(exhibit: Exhibit) -> str:
    tracks = exhibit.__dict__.get("tracks")  # not read where nobody has asked for them yet
    if tracks is None or tracks.left_out < 0.005:
        return ""
    return f" {1 - tracks.left_out:.0%} of the particles are shown."


def open_exhibit(place: Path, scene: Path | None = None, method: str | None = None) -> Exhibit:
    """The scene or submission in the folder `place`.

    scene: that a submission was made for. method: `FILE.py:CLASS` of a submission's method that is not installed.

    Raises SplashbenchError for a folder that is neither, for what `Scene.open` and `splashbench.load` refuse, and for a
    model that fails.
    """
    if not place.is_dir():
        raise SplashbenchError(f"{place} is not a folder; give the folder of a scene or of a submission")
    if (place / IDENTITY).is_file():
        return _open_submission(place, scene, method)
    try:
        return SceneExhibit(Scene.open(place))
    except SplashbenchError as error:
        raise SplashbenchError(f"{error} (as a scene; a submission would have {IDENTITY})") from None


def _open_submission(place: Path, scene: Path | None, method: str | None) -> SubmissionExhibit:
    try:
        exhibit = SubmissionExhibit(load(place, scene, method=method))
        _ = exhibit.extent  # asks the model, too
    except SplashbenchError:
        raise
    except Exception as error:  # a method's code
        said = one_line(f"{type(error).__name__}: {error}")[:500]
        raise SplashbenchError(f"{place}: its model fails ({said}); run the method again") from error
    return exhibit


def require_same_rig(first: Exhibit, second: Exhibit) -> None:
    """Raise SplashbenchError where one camera cannot show both: their cameras stand at different places."""
    common = [name for name in first.cameras if name in second.cameras]
    centers = np.array([camera.center for camera in first.cameras.values()])
    size = float(np.ptp(centers, axis=0).max()) or 1.0
    apart = [float(np.linalg.norm(first.cameras[name].center - second.cameras[name].center)) for name in common]
    if not common or float(np.median(apart)) > _SAME_RIG * size:
        raise SplashbenchError(
            f"{first.place} and {second.place} are of different cameras, and one view cannot show both; "
            "give two of one scene"
        )
