"""Which carriers the container hides from a camera: they are not drawn, and do not explain what a view shows.

Carriers behind the container are left out, decided by its depth at the four pixels about a carrier's centre. Where the
container is a vessel whose edges are where the masks end, its near wall cuts what is behind it pixel by pixel
(near_wall.py). `splashbench.observe.occlusion` is the same for carving. The paper composites by the depth of Gaussians
alone.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from splashbench.errors import SplashbenchError
from splashbench.files import compressed_bytes, read_npz, write_npz
from splashbench.observe.container import depth_image, hidden_share
from splashbench.scene.camera import Camera
from splashbench.scene.container import ContainerMesh

from .near_wall import NearWall, near_wall

_FILE = "container.npz"
# Cameras whose images are in memory; the oldest goes.
_MAX_CAMERAS = 24


def _in_single_precision(mesh: ContainerMesh) -> ContainerMesh:
    """`mesh` with its vertices rounded; itself where that would make two of them one."""
    rounded = ContainerMesh(mesh.vertices.astype(np.float32), mesh.faces)
    return rounded if np.array_equal(rounded.faces, mesh.faces) else mesh


def _smallest(vertices: np.ndarray) -> np.ndarray:
    """`vertices` in single precision where that loses nothing."""
    single = vertices.astype(np.float32)
    return single if np.array_equal(single, vertices) else vertices


class LiquidOcclusion:
    """An opaque container between cameras and liquid.

    mesh: in scene units. tolerance: points this much behind its surface are seen still, scene units. room: bool [F, 2]
    of `room_beside`, and up: unit vector [3], where the near wall cuts pixels; None where carriers are left out alone.
    """

    def __init__(
        self,
        mesh: ContainerMesh,
        tolerance: float,
        room: np.ndarray | None = None,
        up: np.ndarray | None = None,
    ) -> None:
        # As it is stored: a saved container hides the same.
        self.mesh, self.tolerance = _in_single_precision(mesh), tolerance
        self.room, self.up = room, up
        self._depths: dict[int, tuple[Camera, np.ndarray]] = {}
        self._walls: dict[int, tuple[Camera, NearWall | None]] = {}

    def uncut(self) -> LiquidOcclusion:
        """The same container, which leaves carriers out and cuts no pixels."""
        return LiquidOcclusion(self.mesh, self.tolerance)

    def forget(self) -> None:
        """Let go of what is known of cameras' images, which is large; it is made again where it is asked for."""
        self._depths.clear()
        self._walls.clear()

    def depth(self, camera: Camera) -> np.ndarray:
        """Depth of the container in `camera`'s image, float32 [H, W], inf where there is none."""
        # By identity, as arrays make no key; the camera is kept so that its number is not given to another.
        if id(camera) not in self._depths:
            if len(self._depths) >= _MAX_CAMERAS:
                self._depths.pop(next(iter(self._depths)))
            self._depths[id(camera)] = camera, depth_image(self.mesh, camera)
        return self._depths[id(camera)][1]

    def wall(self, camera: Camera) -> NearWall | None:
        """What cuts the liquid in `camera`'s image; None where nothing does."""
        if self.room is None or self.up is None:
            return None
        if id(camera) not in self._walls:
            if len(self._walls) >= _MAX_CAMERAS:
                self._walls.pop(next(iter(self._walls)))
            self._walls[id(camera)] = camera, near_wall(self.mesh, self.room, self.up, camera, self.tolerance)
        return self._walls[id(camera)][1]

    def hidden(self, camera: Camera, points: np.ndarray) -> np.ndarray:
        """float32 [n] in [0, 1]: how far `points` [n, 3] (scene units) lie behind the container for `camera`. What its
        near wall is to cut does not count as hidden."""
        wall = self.wall(camera)
        if wall is not None:
            return wall.hidden(points, self.tolerance)
        return hidden_share(points, self.depth(camera), camera, self.tolerance)

    def cut(self, camera: Camera, points: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
        """Share of each pixel in which the near wall lies before the liquid (float32 [H, W]), and which of `points`
        [n, 3] (scene units) lie before the wall (bool [n]); None where it cuts nothing."""
        wall = self.wall(camera)
        return None if wall is None else (wall.share, wall.in_front(points, self.tolerance))

    def save(self, directory: Path) -> None:
        """Write container.npz into `directory`."""
        write_npz(directory / _FILE, self._arrays)

    @property
    def stored_bytes(self) -> int:
        """How much `save` writes, to within a kilobyte."""
        return compressed_bytes(self._arrays)

    @property
    def _arrays(self) -> dict[str, np.ndarray]:
        arrays: dict[str, np.ndarray] = {
            "vertices": _smallest(self.mesh.vertices),
            "faces": self.mesh.faces.astype(np.int32),
            "tolerance": np.array([self.tolerance]),
        }
        if self.room is not None and self.up is not None:
            arrays |= {"room": self.room, "up": self.up}
        return arrays

    @classmethod
    def load(cls, directory: Path) -> LiquidOcclusion | None:
        """Read what `save` wrote; None where `directory` has none. Raises SplashbenchError naming the file at fault."""
        path = directory / _FILE
        if not path.is_file():
            return None
        arrays = read_npz(path, {"vertices": 2, "faces": 2, "tolerance": 1}, {"room": 2, "up": 1})
        try:
            mesh = ContainerMesh(arrays["vertices"], arrays["faces"])
            room, up = arrays.get("room"), arrays.get("up")
            if (room is None) != (up is None):
                raise ValueError("it has only one of room and up")
            if room is not None and up is not None:
                if room.shape != (len(mesh.faces), 2) or up.shape != (3,):
                    raise ValueError("its arrays do not fit together")
                room = room.astype(bool)
                if abs(float(np.linalg.norm(up)) - 1) > 1e-6:
                    raise ValueError("up is no unit vector")
            tolerance = float(arrays["tolerance"][0])
            if not 0 <= tolerance <= float(np.ptp(mesh.vertices, axis=0).max()):
                raise ValueError(f"a tolerance of {tolerance:g}, larger than the container or negative")
            return cls(mesh, tolerance, room, up)
        except (ValueError, IndexError) as error:
            raise SplashbenchError(f"{path} is not a container ({error}); fit the scene again") from None
