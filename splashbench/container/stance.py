"""Where a mesh stands: its stance in the scene, its centre and principal axes, the rotations that set it upright."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from splashbench.arrays import Floats
from splashbench.errors import SplashbenchError
from splashbench.scene.camera import Camera
from splashbench.scene.container import ContainerMesh

Axis = Literal["x", "-x", "y", "-y", "z", "-z"]
#: directions of a mesh that may point up, the likeliest first: where silhouettes fit alike, the first is taken
AXES: tuple[Axis, ...] = ("y", "z", "-z", "-y", "x", "-x")


@dataclass(frozen=True, eq=False)
class Stance:
    """Where the centred mesh stands: x -> scale * rotation @ x + position, scene units."""

    scale: float
    rotation: Floats  # [3, 3]
    position: Floats  # [3]

    def moved(self, step: Floats, length: float) -> Stance:
        """After a step [6 or 7]: position, rotation vector times `length`, and logarithm of the scale times it."""
        from scipy.spatial.transform import Rotation

        rotation = Rotation.from_rotvec(step[3:6] / length).as_matrix() @ self.rotation
        scale = self.scale * float(np.exp(step[6] / length)) if len(step) > 6 else self.scale
        return Stance(scale, rotation, self.position + step[:3])

    def turned(self, axis: Floats, angle: float) -> Stance:
        """Turned by `angle` radians about an axis [3] of the mesh, through its centre."""
        return Stance(self.scale, self.rotation @ rotation_about(axis, angle), self.position)


def camera_of_mesh(camera: Camera, stance: Stance) -> Camera:
    """The camera in the frame of the mesh and in its unit: it sees the mesh as `camera` sees the placed one."""
    w2c = np.eye(4)
    w2c[:3, :3] = camera.w2c[:3, :3] @ stance.rotation
    w2c[:3, 3] = (camera.w2c[:3, :3] @ stance.position + camera.w2c[:3, 3]) / stance.scale
    return replace(camera, w2c=w2c)


@dataclass(frozen=True, eq=False)
class CentredMesh:
    """A mesh whose surface has its centre at the origin.

    Attributes:
        mesh: shifted by `-centre`.
        centre: [3], mesh units, of the mesh as it came.
        length: half the diagonal, mesh units.
        axes: [3, 3], principal axes of the surface in columns.
        sizes: [3], the surface's variances along them.
    """

    mesh: ContainerMesh
    centre: Floats
    length: float
    axes: Floats
    sizes: Floats

    @classmethod
    def of(cls, mesh: ContainerMesh) -> CentredMesh:
        corners = mesh.triangles
        area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
        if not area.sum() > 0:
            raise SplashbenchError("the container's mesh has no area: its faces are lines; export it again")
        area = area / area.sum()
        centre = area @ corners.mean(axis=1)
        # Second moments of a triangle: of its corners and of its centre, with weights 1/12 and 9/12.
        offset, middle = corners - centre, corners.mean(axis=1) - centre
        moments = np.einsum("f,fki,fkj->ij", area, offset, offset) / 12 + 0.75 * (middle * area[:, None]).T @ middle
        sizes, axes = np.linalg.eigh(moments)
        length = float(np.linalg.norm(np.ptp(mesh.vertices, axis=0))) / 2
        return cls(ContainerMesh(mesh.vertices - centre, mesh.faces), centre, length, axes, sizes)

    def pose(self, stance: Stance) -> Floats:
        """The pose [4, 4] of the mesh as it came."""
        pose = np.eye(4)
        pose[:3, :3] = stance.scale * stance.rotation
        pose[:3, 3] = stance.position - pose[:3, :3] @ self.centre
        return pose

    def stance(self, pose: Floats) -> Stance:
        """The stance of a pose [4, 4] without shear."""
        scale = float(np.cbrt(np.linalg.det(pose[:3, :3])))
        return Stance(scale, pose[:3, :3] / scale, pose[:3, :3] @ self.centre + pose[:3, 3])

    def vertical(self, axis: Axis) -> Floats:
        """The axis [3] of the mesh about which it may look alike: a principal one near `axis`, else `axis` itself.

        A scan is rarely level in its own coordinates.
        """
        along = direction(axis)
        nearest = int(np.argmax(np.abs(along @ self.axes)))
        principal = self.axes[:, nearest] * np.sign(along @ self.axes[:, nearest])
        other_sizes = np.delete(self.sizes, nearest)
        apart = np.abs(other_sizes - self.sizes[nearest]).min() > 3 * np.ptp(other_sizes)
        return principal if apart and principal @ along > 0.9 else along


def direction(axis: str) -> Floats:
    """The unit vector [3] of an axis of the mesh such as "-z"."""
    vector = np.zeros(3)
    vector["xyz".index(axis[-1])] = -1.0 if axis.startswith("-") else 1.0
    return vector


def upright(axis: Axis, upward: Floats) -> Floats:
    """The rotation [3, 3] that takes `axis` of the mesh to `upward` [3]: first to y, then on, the shortest way each."""
    return least_rotation(np.array([0.0, 1.0, 0.0]), upward) @ least_rotation(
        direction(axis), np.array([0.0, 1.0, 0.0])
    )


def least_rotation(a: Floats, b: Floats) -> Floats:
    """The smallest rotation [3, 3] that takes unit vector a to b; about z or x where they are opposite."""
    from scipy.spatial.transform import Rotation

    normal, cosine = np.cross(a, b), float(a @ b)
    if np.linalg.norm(normal) < 1e-9:
        perpendicular = np.array([0.0, 0.0, 1.0]) if abs(a[2]) < 0.9 else np.array([1.0, 0.0, 0.0])
        return np.eye(3) if cosine > 0 else Rotation.from_rotvec(np.pi * perpendicular).as_matrix()
    angle = np.arctan2(np.linalg.norm(normal), cosine)
    return Rotation.from_rotvec(angle * normal / np.linalg.norm(normal)).as_matrix()


def rotation_about(axis: Floats, angle: float) -> Floats:
    """Rotation [3, 3] about a unit vector by `angle` radians."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_rotvec(angle * axis).as_matrix()


def angle_between(a: Floats, b: Floats) -> float:
    """Angle in radians of the rotation between two rotations [3, 3]."""
    return float(np.arccos(np.clip((np.trace(a.T @ b) - 1) / 2, -1, 1)))
