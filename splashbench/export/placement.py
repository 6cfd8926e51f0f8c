"""Where exported things lie: in the scene's own units and axes, or in metres and turned upright."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from splashbench.errors import SplashbenchError
from splashbench.replay import Reconstruction
from splashbench.scene import Camera, Gaussians

#: Where up is: along an axis, or against y, as in files of 3D Gaussians, whose viewers turn them over.
Up = Literal["y", "z", "y-down"]
UPS: dict[Up, tuple[float, float, float]] = {"y": (0, 1, 0), "z": (0, 0, 1), "y-down": (0, -1, 0)}

#: Places farther out, in the export's units, are refused: float32 would soon hold no squares of them.
FARTHEST = 1e30


@dataclass(frozen=True)
class Placement:
    """A turn about the scene's origin and a scale: x of the export is `scale * rotation @ x` of the scene.

    Attributes:
        rotation: [3, 3]. scale: lengths of the export per scene unit.
        units: what lengths are in, "scene units" or "metres". up: where up is, or None: as in the scene, wherever.
    """

    rotation: NDArray[np.float64] = field(default_factory=lambda: np.eye(3))
    scale: float = 1.0
    units: Literal["scene units", "metres"] = "scene units"
    up: Up | None = None

    def points(self, points: NDArray) -> NDArray[np.float64]:
        """Places [..., 3] of the scene in the export; velocities [..., 3] likewise.

        Raises SplashbenchError for what no program could draw: NaN, or beyond `FARTHEST`.
        """
        with np.errstate(over="ignore", invalid="ignore"):
            placed = self.scale * self.directions(points)
        if not (np.abs(placed) <= FARTHEST).all():
            remedy = "leave --metres out, or fit again" if self.units == "metres" else "fit again"
            raise SplashbenchError(f"places or velocities are beyond {FARTHEST:g} {self.units}, or NaN; {remedy}")
        return placed

    def directions(self, directions: NDArray) -> NDArray[np.float64]:
        """Directions [..., 3] of the scene in the export."""
        return np.asarray(np.asarray(directions, dtype=np.float64) @ self.rotation.T)

    def gaussians(self, gaussians: Gaussians) -> Gaussians:
        """`gaussians` of the scene in the export."""
        factors = self.scale * np.einsum("ij,njk->nik", self.rotation, gaussians.factors.astype(np.float64))
        return Gaussians(
            self.points(gaussians.means).astype(np.float32),
            factors.astype(np.float32),
            gaussians.opacities,
            gaussians.colors,
        )

    def camera(self, camera: Camera) -> Camera:
        """The camera that sees in the export what `camera` sees in the scene; its depths are in the export's units."""
        w2c = np.eye(4)
        w2c[:3, :3] = camera.w2c[:3, :3] @ self.rotation.T
        w2c[:3, 3] = self.scale * camera.w2c[:3, 3]
        return replace(camera, w2c=w2c)

    @property
    def matrix(self) -> NDArray[np.float64]:
        """Scene to export, [4, 4]."""
        matrix = np.eye(4)
        matrix[:3, :3] = self.scale * self.rotation
        return matrix


def place(
    reconstruction: Reconstruction,
    *,
    metres: bool = False,
    up: Up | None = None,
    gravity: Sequence[float] | None = None,
) -> Placement:
    """The placement that a user asks for.

    Args:
        metres: whether lengths are in metres, by the scene's metres_per_unit.
        up: the axis that gravity is turned against, by the least turn; None leaves the scene's axes.
        gravity: [3] along which things fall in the scene, where the scene does not say.

    Raises SplashbenchError where the scene does not say what is needed.
    """
    scene = reconstruction.submission.identity.scene
    scale = reconstruction.metres_per_unit if metres else 1.0
    if scale is None:
        raise SplashbenchError(f"scene {scene} states no metres_per_unit; export in scene units, without --metres")
    units: Literal["scene units", "metres"] = "metres" if metres else "scene units"
    if up is None:
        if gravity is not None:
            raise SplashbenchError("gravity alone turns nothing; say which axis is to be up, too (--up)")
        return Placement(scale=scale, units=units)
    falling = reconstruction.gravity if gravity is None else np.asarray(gravity, dtype=np.float64)
    if falling is None:
        raise SplashbenchError(
            f"scene {scene} does not say where gravity points; leave out --up, or give the direction along which "
            "things fall in it, such as --gravity 0 -1 0"
        )
    length = float(np.linalg.norm(falling))
    if falling.shape != (3,) or not 1e-9 < length < 1e9:
        raise SplashbenchError("gravity must be three numbers that give a direction; such as --gravity 0 -1 0")
    return Placement(_least_turn(-falling / length, np.array(UPS[up], dtype=np.float64)), scale, units, up)


def _least_turn(start: NDArray[np.float64], end: NDArray[np.float64]) -> NDArray[np.float64]:
    """The rotation [3, 3] by the least angle that takes the unit vector `start` to `end`.

    From y up to z up it is the usual one, (x, y, z) to (x, -z, y). Half a turn is one about x.
    """
    cosine = float(start @ end)
    if cosine < -1 + 1e-12:
        return np.diag([1.0, -1.0, -1.0])
    x, y, z = np.cross(start, end)
    skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.asarray(np.eye(3) + skew + skew @ skew / (1 + cosine))
