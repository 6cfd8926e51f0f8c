"""Which carriers the container hides from a camera: they are not drawn, and do not explain what a view shows.

Decided per carrier and view, by the container's depth at the four pixels about the carrier's centre, so that a rim cuts
through pixels. `splashbench.observe.occlusion` is the same for carving. The paper composites by the depth of Gaussians
alone.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from splashbench.errors import SplashbenchError
from splashbench.files import read_npz
from splashbench.observe.container import depth_image, hidden_share
from splashbench.scene.camera import Camera
from splashbench.scene.container import ContainerMesh

_FILE = "container.npz"
# Depth images in memory; the oldest goes.
_MAX_DEPTH_IMAGES = 24


class LiquidOcclusion:
    """An opaque container between cameras and liquid.

    mesh: in scene units. tolerance: points this much behind its surface are seen still, scene units.
    """

    def __init__(self, mesh: ContainerMesh, tolerance: float) -> None:
        self.mesh, self.tolerance = mesh, tolerance
        self._depths: dict[int, tuple[Camera, np.ndarray]] = {}

    def depth(self, camera: Camera) -> np.ndarray:
        """Depth of the container in `camera`'s image, float32 [H, W], inf where there is none."""
        # By identity, as arrays make no key; the camera is kept so that its number is not given to another.
        if id(camera) not in self._depths:
            if len(self._depths) >= _MAX_DEPTH_IMAGES:
                self._depths.pop(next(iter(self._depths)))
            self._depths[id(camera)] = camera, depth_image(self.mesh, camera)
        return self._depths[id(camera)][1]

    def hidden(self, camera: Camera, points: np.ndarray) -> np.ndarray:
        """float32 [n] in [0, 1]: how far `points` [n, 3] (scene units) lie behind the container for `camera`."""
        return hidden_share(points, self.depth(camera), camera, self.tolerance)

    def save(self, directory: Path) -> None:
        """Write container.npz into `directory`."""
        np.savez_compressed(
            directory / _FILE, vertices=self.mesh.vertices, faces=self.mesh.faces, tolerance=np.array([self.tolerance])
        )

    @classmethod
    def load(cls, directory: Path) -> LiquidOcclusion | None:
        """Read what `save` wrote; None where `directory` has none. Raises SplashbenchError naming the file at fault."""
        path = directory / _FILE
        if not path.is_file():
            return None
        arrays = read_npz(path, {"vertices": 2, "faces": 2, "tolerance": 1})
        try:
            return cls(ContainerMesh(arrays["vertices"], arrays["faces"]), float(arrays["tolerance"][0]))
        except (ValueError, IndexError) as error:
            raise SplashbenchError(f"{path} is not a container ({error}); fit the scene again") from None
