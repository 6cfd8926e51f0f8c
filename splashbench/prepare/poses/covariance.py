"""How sure structure from motion is of each camera: standard deviations of centres and rotations.

The inverse of the bundle adjustment's normal equations is the covariance of its poses (Triggs et al., "Bundle
adjustment: a modern synthesis", 1999, Sec. 9), where all observations have one noise. Here each image counts with the
noise of its own residuals (White, Econometrica 48(4), 1980), and nothing is assumed of a pixel.

Lenses that are held fixed are not known exactly. A focal length that is off by a thousandth moves its camera by a
thousandth of its distance, without any residual. On a synthetic session that made centres err by six times what the
features' noise explains. So the covariance of the calibrated lenses is carried over to the poses, and given besides.

A reconstruction is free by a similarity, so a covariance depends on the gauge. COLMAP's gauge fixes two cameras, which
then seem exact and make the others seem worse. Here the gauge is the fixed cameras' mean. A deviation is what remains
of their errors after the similarity that best removes them; a radian of rotation counts as much as the rig's radius of
displacement. How sure the scale and the horizon are is another question, which the board, the marker or the measured
distance answers (`scale`).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence, Set
from dataclasses import dataclass, field

import numpy as np
from scipy import linalg, sparse

from splashbench.colmap import pycolmap
from splashbench.prepare.calibration.lens import Array

_STEP = 1e-6  # of central differences, relative to the depth or to the parameter
_MANY = 50.0  # degrees of freedom by which an image's noise is known to a tenth
_MOST = 100.0  # of the variance of all, that is believed of an image with fewer
# Of each model's parameters, the principal point's, which bundle adjustment does not always refine.
_PRINCIPAL = {"FULL_OPENCV": (2, 3), "OPENCV": (2, 3), "SIMPLE_RADIAL": (1, 2)}


@dataclass(frozen=True)
class PoseSigmas:
    """Root mean square errors to expect by image name, over all three axes together.

    Centres in units of the reconstruction, rotations in degrees. `feature_centre`, `feature_rotation_deg`: by the noise
    of the features alone, as if the fixed lenses were exact.
    """

    centre: dict[str, float] = field(default_factory=dict)
    rotation_deg: dict[str, float] = field(default_factory=dict)
    feature_centre: dict[str, float] = field(default_factory=dict)
    feature_rotation_deg: dict[str, float] = field(default_factory=dict)


def pose_sigmas(
    reconstruction: pycolmap.Reconstruction,
    names: Sequence[str],
    fixed_lenses: Set[int],
    principal_point_refined: bool = False,
    lens_covariance: Mapping[int, Array] | None = None,
) -> PoseSigmas | None:
    """Standard deviations of the poses of the images `names`, relative to each other (see above).

    `fixed_lenses`: COLMAP's numbers of the cameras whose intrinsics were not refined; `principal_point_refined`:
    whether that of the others was. `lens_covariance`: of some of the fixed lenses, by COLMAP's number, [9, 9] for fx,
    fy, cx, cy, k1, k2, p1, p2, k3; the others count as exact. None where fewer than two of the images have a pose, or
    where the observations or the lenses do not determine them.
    """
    images = sorted((image for image in reconstruction.images.values() if image.has_pose), key=lambda i: i.name)
    chosen = [index for index, image in enumerate(images) if image.name in set(names)]
    lens_covariance = lens_covariance or {}
    if len(chosen) < 2 or not reconstruction.points3D or not are_determined(lens_covariance.values()):
        return None
    system = _reduced_system(reconstruction, images, fixed_lenses, principal_point_refined, lens_covariance)
    if system is None:
        return None
    centres = np.array([-_rotation(image).T @ _translation(image) for image in images])
    radius = float(np.sqrt(((centres[chosen] - centres[chosen].mean(0)) ** 2).sum(1).mean()))
    if radius <= 0:
        return None
    generators = np.zeros((len(system.normal), 7))
    for index, image in enumerate(images):
        generators[6 * index : 6 * index + 6] = similarity_generators(_rotation(image), centres[index])
    try:
        inverse = inverse_without_gauge(system.normal, generators)
    except linalg.LinAlgError:
        return None
    by_features = inverse @ system.noise(inverse) @ inverse
    covariance = by_features + inverse @ system.lenses @ inverse
    rows = np.concatenate([np.arange(6 * index, 6 * index + 6) for index in chosen])
    labels = [images[index].name for index in chosen]
    sigmas: list[dict[str, float]] = []
    for of in (covariance, by_features):
        squares = relative_variances(of[np.ix_(rows, rows)], generators[rows], radius)
        if not np.isfinite(squares).all() or (squares < 0).any():
            return None
        sigmas.append({name: float(np.sqrt(value)) for name, value in zip(labels, squares[:, 1])})
        sigmas.append({name: float(np.degrees(np.sqrt(value))) for name, value in zip(labels, squares[:, 0])})
    return PoseSigmas(*sigmas)


@dataclass(frozen=True)
class _System:
    """The normal equations of poses (rotation, then centre, 6 each) and refined intrinsics, points eliminated.

    Attributes:
        normal: [M, M], J^T J.
        per_image: of each image its share of `normal`; its residuals' squares, px^2; its number of coordinates; and how
            many of these the points take up.
        variance: of all residuals, per coordinate, px^2.
        lenses: [M, M], what the uncertainty of the fixed lenses adds to the variance of the right side.
    """

    normal: Array
    per_image: list[tuple[Array, float, int, float]]
    variance: float
    lenses: Array

    def noise(self, inverse: Array) -> Array:
        """[M, M]: variance of the right side by the noise of the features, each image's own."""
        total = np.zeros_like(self.normal)
        for share, squares, count, by_points in self.per_image:
            # The unknowns fit themselves to the noise: what remains of it is less by its share of them.
            freedom = count - by_points - float((share * inverse).sum())
            own = squares / freedom if freedom > 0 else np.inf
            # Of few residuals the variance is itself uncertain, and never taken for less than that of all.
            total += (own if freedom >= _MANY else max(self.variance, min(own, _MOST * self.variance))) * share
        return total


def _reduced_system(
    reconstruction: pycolmap.Reconstruction,
    images: Sequence[pycolmap.Image],
    fixed_lenses: Set[int],
    principal_point_refined: bool,
    lens_covariance: Mapping[int, Array],
) -> _System | None:
    """The system of all images; None where there are fewer observations than unknowns."""
    numbers = {key: index for index, key in enumerate(reconstruction.points3D)}
    refined: dict[int, tuple[int, list[int]]] = {}  # camera -> first column, its refined parameters
    n_columns = 6 * len(images)
    for camera_id in sorted({image.camera_id for image in images} - fixed_lenses):
        camera = reconstruction.cameras[camera_id]
        principal = () if principal_point_refined else _PRINCIPAL[camera.model.name]
        free = [index for index in range(len(camera.params)) if index not in principal]
        refined[camera_id] = (n_columns, free)
        n_columns += len(free)
    rows, columns, values, point_rows, point_values, points = [], [], [], [], [], []
    squares: list[float] = []
    lens_slopes: list[Array | None] = []  # of each image, its derivatives by its lens where that is uncertain
    lens_of: list[int] = []  # COLMAP's camera of each image
    ends, n_rows = [], 0
    for index, image in enumerate(images):
        observed = [point for point in image.points2D if point.has_point3D()]
        if not observed:
            continue
        camera = reconstruction.cameras[image.camera_id]
        R, world = _rotation(image), np.array([reconstruction.points3D[p.point3D_id].xyz for p in observed])
        rotated = world @ R.T
        local = rotated + _translation(image)
        squares.append(float(((_project(camera, local) - np.array([p.xy for p in observed])) ** 2).sum()))
        d_local = _local_jacobian(camera, local)
        # A turn w of the camera moves a point by w x local when its centre stays; a step of its centre by -R step.
        d_turn = -np.einsum("nij,njk->nik", d_local, cross_matrices(local))
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
        uncertain = image.camera_id in lens_covariance
        lens_slopes.append(_parameter_jacobian(camera, local, range(9)).reshape(-1, 9) if uncertain else None)
        lens_of.append(image.camera_id)
        n_rows += 2 * len(observed)
        ends.append(n_rows)
    unknowns = n_columns + 3 * len(numbers) - 7
    if n_rows <= unknowns:
        return None
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
    normal, lenses = np.zeros((n_columns, n_columns)), np.zeros((n_columns, n_columns))
    pushes = {camera_id: np.zeros((n_columns, 9)) for camera_id in lens_covariance}
    per_image = []
    for first, last, own_squares, camera_id, slopes in zip([0, *ends], ends, squares, lens_of, lens_slopes):
        reduced = J[first:last].toarray() - J_points[first:last] @ coupling.T  # what the points cannot account for
        share = reduced.T @ reduced
        by_points = float(J_points[first:last].power(2).sum())
        per_image.append((share, own_squares, last - first, by_points))
        normal += share
        if slopes is not None:
            pushes[camera_id] += reduced.T @ slopes
    for camera_id, push in pushes.items():
        lenses += push @ lens_covariance[camera_id] @ push.T
    return _System(normal, per_image, sum(squares) / (n_rows - unknowns), lenses)


def are_determined(lens_covariance: Iterable[Array]) -> bool:
    """Whether no lens has a parameter that its board left open (see `Calibration`)."""
    return all(bool(np.isfinite(covariance).all()) for covariance in lens_covariance)


def inverse_without_gauge(normal: Array, generators: Array) -> Array:
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


def relative_variances(covariance: Array, generators: Array, radius: float) -> Array:
    """[C, 2]: variances of the turns and centres of C cameras, less the motion that best removes their errors.

    `covariance`: [6C, 6C]; `generators`: [6C, G], of the motions; `radius`: of the rig, which makes a turn and a
    displacement comparable.
    """
    weights = np.tile([1.0, 1.0, 1.0, *([1 / radius**2] * 3)], len(covariance) // 6)
    weighted = generators.T * weights
    remain = np.eye(len(covariance)) - generators @ np.linalg.solve(weighted @ generators, weighted)
    return np.asarray(np.diag(remain @ covariance @ remain.T).reshape(-1, 2, 3).sum(-1))


def similarity_generators(R: Array, centre: Array) -> Array:
    """[6, 7]: how a camera's turn (in its own axes) and centre follow a turn, a growth and a step of the world."""
    generators = np.zeros((6, 7))
    generators[:3, :3] = -R
    generators[3:, :3] = -cross_matrices(centre[None])[0]
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


def cross_matrices(vectors: Array) -> Array:
    """[N, 3, 3], of which each times x is the cross product of a vector [N, 3] with x."""
    x, y, z = vectors.T
    zero = np.zeros_like(x)
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=1).reshape(-1, 3, 3)
