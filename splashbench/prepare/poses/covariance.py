"""How sure structure from motion is of each camera: standard deviations of centres and rotations.

The inverse of the bundle adjustment's normal equations is the covariance of its poses (Triggs et al., "Bundle
adjustment: a modern synthesis", 1999, Sec. 9). It is scaled by the residuals' variance instead of an assumed pixel.

A reconstruction is free by a similarity, so a covariance depends on the gauge. COLMAP's gauge fixes two cameras, which
then seem exact and make the others seem worse. Here the gauge is the fixed cameras' mean. A deviation is what remains
of their errors after the similarity that best removes them; a radian of rotation counts as much as the rig's radius of
displacement. How sure the scale and the horizon are is another question, which the board, the marker or the measured
distance answers (`scale`).
"""

from __future__ import annotations

from collections.abc import Sequence, Set
from dataclasses import dataclass, field

import numpy as np
from scipy import linalg, sparse

from splashbench.colmap import pycolmap
from splashbench.prepare.calibration.lens import Array

_STEP = 1e-6  # of central differences, relative to the depth or to the parameter
# Of each model's parameters, the principal point's, which bundle adjustment does not always refine.
_PRINCIPAL = {"FULL_OPENCV": (2, 3), "OPENCV": (2, 3), "SIMPLE_RADIAL": (1, 2)}


@dataclass(frozen=True)
class PoseSigmas:
    """Root mean square errors to expect by image name, over all three axes together.

    Centres in units of the reconstruction, rotations in degrees.
    """

    centre: dict[str, float] = field(default_factory=dict)
    rotation_deg: dict[str, float] = field(default_factory=dict)


def pose_sigmas(
    reconstruction: pycolmap.Reconstruction,
    names: Sequence[str],
    fixed_lenses: Set[int],
    principal_point_refined: bool = False,
) -> PoseSigmas | None:
    """Standard deviations of the poses of the images `names`, relative to each other (see above).

    `fixed_lenses`: COLMAP's numbers of the cameras whose intrinsics were not refined; `principal_point_refined`:
    whether that of the others was. None where fewer than two of the images have a pose, or where the observations do
    not determine them.
    """
    images = sorted((image for image in reconstruction.images.values() if image.has_pose), key=lambda i: i.name)
    chosen = [index for index, image in enumerate(images) if image.name in set(names)]
    if len(chosen) < 2 or not reconstruction.points3D:
        return None
    normal, variance = _reduced_normal_matrix(reconstruction, images, fixed_lenses, principal_point_refined)
    if normal is None:
        return None
    centres = np.array([-_rotation(image).T @ _translation(image) for image in images])
    radius = float(np.sqrt(((centres[chosen] - centres[chosen].mean(0)) ** 2).sum(1).mean()))
    if radius <= 0:
        return None
    generators = np.zeros((len(normal), 7))
    for index, image in enumerate(images):
        generators[6 * index : 6 * index + 6] = _similarity_generators(_rotation(image), centres[index])
    try:
        covariance = variance * _inverse_without_gauge(normal, generators)
    except linalg.LinAlgError:
        return None
    rows = np.concatenate([np.arange(6 * index, 6 * index + 6) for index in chosen])
    free, gauge = covariance[np.ix_(rows, rows)], generators[rows]
    weights = np.tile([1.0, 1.0, 1.0, *([1 / radius**2] * 3)], len(chosen))
    # What no similarity of the chosen cameras can take away.
    remain = np.eye(len(rows)) - gauge @ np.linalg.solve(gauge.T @ (weights[:, None] * gauge), gauge.T * weights)
    deviations = np.diag(remain @ free @ remain.T).reshape(-1, 2, 3).sum(-1)
    if not np.isfinite(deviations).all() or (deviations < 0).any():
        return None
    labels = [images[index].name for index in chosen]
    return PoseSigmas(
        centre={name: float(np.sqrt(value)) for name, value in zip(labels, deviations[:, 1])},
        rotation_deg={name: float(np.degrees(np.sqrt(value))) for name, value in zip(labels, deviations[:, 0])},
    )


def _reduced_normal_matrix(
    reconstruction: pycolmap.Reconstruction,
    images: Sequence[pycolmap.Image],
    fixed_lenses: Set[int],
    principal_point_refined: bool,
) -> tuple[Array | None, float]:
    """J^T J of the poses (rotation, then centre, 6 each) and refined intrinsics, points eliminated; and the
    residuals' variance per coordinate, px^2. No matrix where there are fewer observations than unknowns."""
    numbers = {key: index for index, key in enumerate(reconstruction.points3D)}
    refined: dict[int, tuple[int, list[int]]] = {}  # camera -> first column, its refined parameters
    n_columns = 6 * len(images)
    for camera_id in sorted({image.camera_id for image in images} - fixed_lenses):
        camera = reconstruction.cameras[camera_id]
        principal = () if principal_point_refined else _PRINCIPAL[camera.model.name]
        free = [index for index in range(len(camera.params)) if index not in principal]
        refined[camera_id] = (n_columns, free)
        n_columns += len(free)
    rows, columns, values, point_rows, point_values, points, squares = [], [], [], [], [], [], 0.0
    n_rows = 0
    for index, image in enumerate(images):
        observed = [point for point in image.points2D if point.has_point3D()]
        if not observed:
            continue
        camera = reconstruction.cameras[image.camera_id]
        R, world = _rotation(image), np.array([reconstruction.points3D[p.point3D_id].xyz for p in observed])
        rotated = world @ R.T
        local = rotated + _translation(image)
        squares += float(((_project(camera, local) - np.array([p.xy for p in observed])) ** 2).sum())
        d_local = _local_jacobian(camera, local)
        # A turn w of the camera moves a point by w x local when its centre stays; a step of its centre by -R step.
        d_turn = -np.einsum("nij,njk->nik", d_local, _cross_matrices(local))
        d_point = d_local @ R
        blocks = [(6 * index, d_turn), (6 * index + 3, -d_point)]
        if image.camera_id in refined:
            first, free = refined[image.camera_id]
            blocks.append((first, _parameter_jacobian(camera, local, free)))
        own_rows = n_rows + np.arange(2 * len(observed)).reshape(-1, 2)
        for first, block in blocks:
            width = block.shape[2]
            rows.append(np.repeat(own_rows[..., None], width, 2).ravel())
            columns.append(np.broadcast_to(first + np.arange(width), block.shape).ravel())
            values.append(block.ravel())
        point_rows.append(own_rows)
        point_values.append(d_point)
        points.append([numbers[p.point3D_id] for p in observed])
        n_rows += 2 * len(observed)
    unknowns = n_columns + 3 * len(numbers) - 7
    if n_rows <= unknowns:
        return None, 0.0
    J = sparse.csr_matrix(
        (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))), shape=(n_rows, n_columns)
    )
    d_points, seen, seen_rows = np.concatenate(point_values), np.concatenate(points), np.concatenate(point_rows)
    information = np.zeros((len(numbers), 3, 3))
    np.add.at(information, seen, np.einsum("nki,nkj->nij", d_points, d_points))
    usable = np.linalg.cond(information) < 1e14
    # Columns scaled by the Cholesky factor of each point's information, so that eliminating them is one product.
    whitening = np.zeros_like(information)
    whitening[usable] = np.linalg.inv(np.linalg.cholesky(information[usable])).transpose(0, 2, 1)
    whitened = d_points @ whitening[seen]
    J_points = sparse.csr_matrix(
        (
            whitened.ravel(),
            (
                np.repeat(seen_rows[..., None], 3, 2).ravel(),
                np.broadcast_to(3 * seen[:, None, None] + np.arange(3), whitened.shape).ravel(),
            ),
        ),
        shape=(n_rows, 3 * len(numbers)),
    )
    coupling = (J.T @ J_points).toarray()
    return (J.T @ J).toarray() - coupling @ coupling.T, squares / (n_rows - unknowns)


def _inverse_without_gauge(normal: Array, generators: Array) -> Array:
    """Inverse of the normal matrix, which is singular along the seven `generators`, in the gauge orthogonal to them.

    The columns are scaled to unit diagonal first: intrinsics and poses differ by many orders of magnitude.
    Raises LinAlgError where anything else is undetermined.
    """
    scale = 1 / np.sqrt(np.maximum(np.diag(normal), 1e-300))
    scaled = normal * scale[:, None] * scale
    basis = linalg.orth(generators / scale[:, None])
    lifted = scaled + basis @ basis.T  # has the same inverse, but for the gauge's own directions
    factor = linalg.cho_factor(lifted)
    inverse = linalg.cho_solve(factor, np.eye(len(lifted))) - basis @ basis.T
    return np.asarray(inverse * scale[:, None] * scale)


def _similarity_generators(R: Array, centre: Array) -> Array:
    """[6, 7]: how a camera's turn (in its own axes) and centre follow a turn, a growth and a step of the world."""
    generators = np.zeros((6, 7))
    generators[:3, :3] = -R
    generators[3:, :3] = -_cross_matrices(centre[None])[0]
    generators[3:, 3] = centre
    generators[3:, 4:] = np.eye(3)
    return generators


def _local_jacobian(camera: pycolmap.Camera, local: Array) -> Array:
    """Of pixels by points in camera coordinates: [N, 2, 3]."""
    step = _STEP * np.abs(local[:, 2:])
    slopes = [
        (_project(camera, local + step * axis) - _project(camera, local - step * axis)) / (2 * step)
        for axis in np.eye(3)
    ]
    return np.stack(slopes, axis=2)


def _parameter_jacobian(camera: pycolmap.Camera, local: Array, free: Sequence[int]) -> Array:
    """Of pixels by the camera's refined parameters: [N, 2, len(free)]."""
    slopes = []
    for index in free:
        step = _STEP * max(1.0, abs(camera.params[index]))
        ends = []
        for sign in (1, -1):
            changed = pycolmap.Camera(camera.todict())
            params = np.array(camera.params)
            params[index] += sign * step
            changed.params = params
            ends.append(_project(changed, local))
        slopes.append((ends[0] - ends[1]) / (2 * step))
    return np.stack(slopes, axis=2)


def _project(camera: pycolmap.Camera, local: Array) -> Array:
    return np.asarray(camera.img_from_cam(local), np.float64)


def _rotation(image: pycolmap.Image) -> Array:
    return np.asarray(image.cam_from_world().rotation.matrix(), np.float64)


def _translation(image: pycolmap.Image) -> Array:
    return np.asarray(image.cam_from_world().translation, np.float64)


def _cross_matrices(vectors: Array) -> Array:
    """[N, 3, 3], of which each times x is the cross product of a vector [N, 3] with x."""
    x, y, z = vectors.T
    zero = np.zeros_like(x)
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=1).reshape(-1, 3, 3)
