"""Camera poses by a board that several cameras see at once: the other way beside structure from motion.

Common in laboratories (caliscope, Pose2Sim): the calibration board is carried through the volume that the cameras
share. Nothing need be textured, no sweep is filmed, and the board's size gives metres. Each sighting places its camera
against the board (perspective-n-point). Two cameras that see the board in one instant are so placed against each other.
These pairs make a graph; its strongest tree, by sightings in common, gives every camera a first pose. Bundle adjustment
then fits all cameras and all places of the board together, with the board rigid (Triggs et al., "Bundle adjustment: a
modern synthesis", 1999; Levenberg-Marquardt, Huber's weights).

Deviations: the corners of one sighting err together, since the board bends and the image blurs one way. So the larger
of two estimates counts: all corners independent, and the instants independent of each other (Liang and Zeger,
Biometrika 73(1), 1986). What the lenses' own deviations add is carried over as in `covariance`. The size of the board
is known, so only a rigid motion is taken out, and an error of the scale counts.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from splashbench.arrays import Indices
from splashbench.errors import SplashbenchError
from splashbench.prepare.calibration.board import BoardView
from splashbench.prepare.calibration.lens import Array, Lens
from splashbench.prepare.poses.covariance import (
    are_determined,
    cross_matrices,
    inverse_without_gauge,
    relative_variances,
    similarity_generators,
)
from splashbench.prepare.poses.structure_from_motion import Poses

MIN_SHARED = 3  # instants that a camera must share with one that has a pose: fewer are too easily all wrong
MAX_ROUNDS, MAX_STEPS = 4, 60
MIN_DAMPING = 1e-10  # of the diagonal: without any, the equations are singular along the gauge
OUTLIER_FACTOR = 3.0  # a sighting this many times worse than the median one is blurred or misread
HUBER = 1.345  # standard deviations beyond which a residual weighs less
MIN_OUTLIER_PX = 0.5
_STEP = 1e-6
_RIGID = (0, 1, 2, 4, 5, 6)  # of the similarity's generators, all but growth


@dataclass(frozen=True)
class _Seen:
    """One sighting: numbers of the camera and of the instant; corners [N, 3] on the board; pixels [N, 2]."""

    camera: int
    instant: int
    points: Array
    pixels: Array


@dataclass
class _State:
    """World to camera, and board to world: rotations [C, 3, 3] and [B, 3, 3], camera centres and places of the board's
    corner [C, 3] and [B, 3], metres."""

    turns: Array
    centres: Array
    board_turns: Array
    board_places: Array


def board_poses(
    sightings: Mapping[str, Sequence[BoardView | None]],
    lenses: Mapping[str, Lens],
    lens_covariance: Mapping[str, Array] | None = None,
) -> Poses:
    """Poses of all cameras, in metres, in the frame of the first.

    `sightings`: camera -> what it saw of the board in each instant, the same instants for all cameras.
    `lens_covariance`: see `Calibration`. Raises SplashbenchError naming the cameras that share too few instants.
    """
    cameras = list(sightings)
    seen = [
        _Seen(c, k, np.column_stack([view.points, np.zeros(len(view.points))]), view.pixels)
        for c, camera in enumerate(cameras)
        for k, view in enumerate(sightings[camera])
        if view is not None
    ]
    ordered = [lenses[camera] for camera in cameras]
    seen, state = _first_guess(cameras, seen, ordered)
    for _ in range(MAX_ROUNDS):
        state = _adjusted(state, seen, ordered)
        errors = np.array([np.sqrt((_residuals(state, s, ordered) ** 2).sum(1).mean()) for s in seen])
        limit = max(OUTLIER_FACTOR * float(np.median(errors)), MIN_OUTLIER_PX)
        kept = _shared([s for s, error in zip(seen, errors) if error <= limit])
        if len(kept) == len(seen):
            break
        _require_linked(cameras, kept)
        seen = kept
    return _collected(cameras, state, seen, ordered, lens_covariance or {})


def _first_guess(cameras: Sequence[str], seen: list[_Seen], lenses: Sequence[Lens]) -> tuple[list[_Seen], _State]:
    """A pose for every camera along the strongest tree, and a place of the board for every instant that is kept."""
    placed: dict[tuple[int, int], Array] = {}  # camera, instant -> board to camera [4, 4]
    for s in seen:
        pose = _board_to_camera(s, lenses[s.camera])
        if pose is not None:
            placed[s.camera, s.instant] = pose
    seen = _shared([s for s in seen if (s.camera, s.instant) in placed])
    _require_linked(cameras, seen)
    instants = _instants(cameras, seen)
    world_to_camera: dict[int, Array] = {0: np.eye(4)}
    while len(world_to_camera) < len(cameras):
        _, a, b = max(
            (len(instants[a] & instants[b]), -a, -b)
            for a in world_to_camera
            for b in range(len(cameras))
            if b not in world_to_camera
        )
        between = [placed[-b, k] @ np.linalg.inv(placed[-a, k]) for k in sorted(instants[-a] & instants[-b])]
        world_to_camera[-b] = _middle_one(between) @ world_to_camera[-a]
    boards: dict[int, Array] = {}
    for k in sorted(set().union(*instants)):
        places = [np.linalg.inv(world_to_camera[c]) @ placed[c, k] for c, own in enumerate(instants) if k in own]
        boards[k] = _middle_one(places)
    numbers = {k: index for index, k in enumerate(boards)}
    kept = [_Seen(s.camera, numbers[s.instant], s.points, s.pixels) for s in seen]
    matrices = np.array([world_to_camera[c] for c in range(len(cameras))])
    board_matrices = np.array(list(boards.values()))
    return kept, _State(
        matrices[:, :3, :3],
        -np.einsum("nji,nj->ni", matrices[:, :3, :3], matrices[:, :3, 3]),
        board_matrices[:, :3, :3],
        board_matrices[:, :3, 3],
    )


def _board_to_camera(s: _Seen, lens: Lens) -> Array | None:
    """The board's pose [4, 4] by this sighting alone; None where none fits."""
    solved, turn, step = cv2.solvePnP(s.points, lens.normalise(s.pixels), np.eye(3), None, flags=cv2.SOLVEPNP_IPPE)
    if not solved:
        return None
    turn, step = cv2.solvePnPRefineLM(s.points, lens.normalise(s.pixels), np.eye(3), None, turn, step)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = cv2.Rodrigues(turn)[0], np.ravel(step)
    return pose if np.isfinite(pose).all() and pose[2, 3] > 0 else None


def _middle_one(poses: Sequence[Array]) -> Array:
    """The pose that the others agree with best: a board seen head-on has a second pose that is wrong."""
    stack = np.array(poses)
    reach = max(float(np.median(np.linalg.norm(stack[:, :3, 3], axis=1))), 1e-9)
    turned = np.linalg.norm(stack[:, None, :3, :3] - stack[None, :, :3, :3], axis=(2, 3))
    apart = np.linalg.norm(stack[:, None, :3, 3] - stack[None, :, :3, 3], axis=2) / reach
    return np.asarray(stack[int(np.argmin(np.median(turned + apart, axis=1)))])


def _shared(seen: Sequence[_Seen]) -> list[_Seen]:
    """The sightings of instants in which another camera saw the board as well."""
    counts: dict[int, int] = {}
    for s in seen:
        counts[s.instant] = counts.get(s.instant, 0) + 1
    return [s for s in seen if counts[s.instant] > 1]


def _instants(cameras: Sequence[str], seen: Sequence[_Seen]) -> list[set[int]]:
    """Of each camera, the instants in which it saw the board."""
    return [{s.instant for s in seen if s.camera == c} for c in range(len(cameras))]


def _require_linked(cameras: Sequence[str], seen: Sequence[_Seen]) -> None:
    """Raise SplashbenchError where the instants that pairs of cameras share do not join all of them."""
    instants = _instants(cameras, seen)
    linked, apart = {0}, set(range(1, len(cameras)))
    while near := {b for b in apart if any(len(instants[a] & instants[b]) >= MIN_SHARED for a in linked)}:
        linked |= near
        apart -= near
    if apart:
        fewer = min(apart, linked, key=len)  # the first camera may be the one that saw nothing
        raise SplashbenchError(
            f"[recordings.extrinsics]: camera {', '.join(cameras[c] for c in sorted(fewer))} and the others see the"
            f" board together in fewer than {MIN_SHARED} instants; carry it to where this camera and another both see"
            " it, and hold it still there"
        )


def _local(state: _State, s: _Seen) -> tuple[Array, Array]:
    """Corners about the board's place, in the world's axes [N, 3], and in camera coordinates [N, 3]."""
    about = s.points @ state.board_turns[s.instant].T
    world = about + state.board_places[s.instant]
    return about, (world - state.centres[s.camera]) @ state.turns[s.camera].T


def _residuals(state: _State, s: _Seen, lenses: Sequence[Lens]) -> Array:
    """[N, 2] pixels, projected less seen."""
    _, local = _local(state, s)
    local = np.column_stack([local[:, :2], np.maximum(local[:, 2], 1e-3)])
    return lenses[s.camera].project(local) - s.pixels


def _jacobians(state: _State, s: _Seen, lenses: Sequence[Lens]) -> tuple[Array, Array]:
    """[2N, 6] of the pixels by the camera's turn (its own axes) and centre, and by the board's turn and place."""
    about, local = _local(state, s)
    step = _STEP * np.abs(local[:, 2:])
    lens, turn = lenses[s.camera], state.turns[s.camera]
    slopes = np.stack(
        [(lens.project(local + step * axis) - lens.project(local - step * axis)) / (2 * step) for axis in np.eye(3)],
        axis=2,
    )
    by_place = slopes @ turn
    by_camera = np.concatenate([-np.einsum("nij,njk->nik", slopes, cross_matrices(local)), -by_place], axis=2)
    by_board = np.concatenate([-np.einsum("nij,njk->nik", by_place, cross_matrices(about)), by_place], axis=2)
    return by_camera.reshape(-1, 6), by_board.reshape(-1, 6)


def _adjusted(state: _State, seen: Sequence[_Seen], lenses: Sequence[Lens]) -> _State:
    """The state that fits all sightings best (Levenberg-Marquardt); the gauge is left to the damping."""
    damping = 1e-3
    cost, scale = _cost(state, seen, lenses, None)
    for _ in range(MAX_STEPS):
        normal, gradient = _normal_equations(state, seen, lenses, scale)
        diagonal = np.maximum(np.diag(normal), 1e-12)
        improved = False
        while not improved and damping < 1e8:
            change = np.asarray(np.linalg.solve(normal + np.diag(damping * diagonal), -gradient), np.float64)
            candidate = _moved(state, change)
            candidate_cost, _ = _cost(candidate, seen, lenses, scale)
            improved = candidate_cost < cost
            damping = max(damping / 10, MIN_DAMPING) if improved else damping * 10
        if not improved:
            break
        drop = cost - candidate_cost
        state = candidate
        cost, scale = _cost(state, seen, lenses, None)
        if drop < 1e-10 * max(cost, 1e-30):
            break
    return state


def _cost(state: _State, seen: Sequence[_Seen], lenses: Sequence[Lens], scale: float | None) -> tuple[float, float]:
    """Huber's cost at a noise of `scale` pixels, by default the residuals' own; and that scale."""
    distances = np.concatenate([np.linalg.norm(_residuals(state, s, lenses), axis=1) for s in seen])
    if scale is None:
        scale = max(float(np.median(distances)) / 1.1774, 1e-6)  # of a distance in the plane
    bend = HUBER * scale
    parts = np.where(distances <= bend, 0.5 * distances**2, bend * (distances - 0.5 * bend))
    return float(parts.sum()), scale


def _normal_equations(
    state: _State, seen: Sequence[_Seen], lenses: Sequence[Lens], scale: float
) -> tuple[Array, Array]:
    """J^T J [M, M] and J^T r [M], weighted: six columns for each camera, then six for each place of the board."""
    n_cameras = len(state.turns)
    size = 6 * (n_cameras + len(state.board_turns))
    normal, gradient = np.zeros((size, size)), np.zeros(size)
    for s in seen:
        residual = _residuals(state, s, lenses)
        weight = np.minimum(1.0, HUBER * scale / np.maximum(np.linalg.norm(residual, axis=1), 1e-12))
        both = np.concatenate(_jacobians(state, s, lenses), axis=1)
        weighted = both * np.repeat(weight, 2)[:, None]
        columns = _columns(s, n_cameras)
        normal[np.ix_(columns, columns)] += both.T @ weighted
        gradient[columns] += weighted.T @ residual.ravel()
    return normal, gradient


def _columns(s: _Seen, n_cameras: int) -> Indices:
    first, second = 6 * s.camera, 6 * (n_cameras + s.instant)
    return np.concatenate([np.arange(first, first + 6), np.arange(second, second + 6)])


def _moved(state: _State, change: Array) -> _State:
    steps = change.reshape(-1, 2, 3)
    cameras, boards = np.split(steps, [len(state.turns)])
    return _State(
        Rotation.from_rotvec(cameras[:, 0]).as_matrix() @ state.turns,
        state.centres + cameras[:, 1],
        Rotation.from_rotvec(boards[:, 0]).as_matrix() @ state.board_turns,
        state.board_places + boards[:, 1],
    )


def _deviations(
    state: _State,
    seen: Sequence[_Seen],
    lenses: Sequence[Lens],
    lens_covariance: Mapping[int, Array],
) -> tuple[Array, Array] | None:
    """Root mean square errors to expect of turns (radians) and centres (metres), [C, 2] each: in all, and by the
    corners' noise alone; None where the sightings do not determine them."""
    n_cameras = len(state.turns)
    size = 6 * n_cameras
    if not are_determined(lens_covariance.values()):
        return None
    normal = np.zeros((size, size))
    instants = sorted({s.instant for s in seen})
    scores, pushes = [], {c: np.zeros((size, 9)) for c in lens_covariance}
    squares, count = 0.0, 0
    for k in instants:
        rows = [s for s in seen if s.instant == k]
        jacobian = np.zeros((sum(2 * len(s.points) for s in rows), size))
        by_board, residual = np.zeros((len(jacobian), 6)), np.zeros(len(jacobian))
        slopes: list[tuple[int, slice, Array]] = []
        first = 0
        for s in rows:
            at = slice(first, first + 2 * len(s.points))
            camera, board = _jacobians(state, s, lenses)
            jacobian[at, 6 * s.camera : 6 * s.camera + 6], by_board[at] = camera, board
            residual[at] = _residuals(state, s, lenses).ravel()
            if s.camera in lens_covariance:
                slopes.append((s.camera, at, _lens_jacobian(lenses[s.camera], _local(state, s)[1])))
            first = at.stop
        # What the board's place cannot account for.
        basis, _ = np.linalg.qr(by_board)
        jacobian -= basis @ (basis.T @ jacobian)
        normal += jacobian.T @ jacobian
        scores.append(jacobian.T @ residual)
        squares += float(residual @ residual)
        count += len(residual)
        for camera_number, at, by_lens in slopes:
            pushes[camera_number] += jacobian[at].T @ by_lens
    freedom = count - 6 * len(instants) - size + 6
    if freedom <= 0:
        return None
    generators = np.concatenate(
        [similarity_generators(turn, centre)[:, _RIGID] for turn, centre in zip(state.turns, state.centres)]
    )
    try:
        inverse = inverse_without_gauge(normal, generators)
    except np.linalg.LinAlgError:
        return None
    gradients = np.stack(scores)
    clustered = inverse @ (gradients.T @ gradients) @ inverse * len(instants) / max(len(instants) - 1, 1)
    by_lenses = sum(
        (inverse @ p @ lens_covariance[c] @ p.T @ inverse for c, p in pushes.items()), np.zeros_like(normal)
    )
    radius = float(np.sqrt(((state.centres - state.centres.mean(0)) ** 2).sum(1).mean()))
    independent, together, from_lenses = (
        relative_variances(covariance, generators, max(radius, 1e-9))
        for covariance in (squares / freedom * inverse, clustered, by_lenses)
    )
    by_corners = np.maximum(independent, together)
    total = by_corners + from_lenses
    if not np.isfinite(total).all() or (by_corners < 0).any():
        return None
    return np.sqrt(total), np.sqrt(by_corners)


def _lens_jacobian(lens: Lens, local: Array) -> Array:
    """[2N, 9] of the pixels by fx, fy, cx, cy, k1, k2, p1, p2, k3."""
    parameters = np.concatenate([[lens.K[0, 0], lens.K[1, 1], lens.K[0, 2], lens.K[1, 2]], lens.distortion])
    slopes = []
    for index in range(9):
        step = np.zeros(9)
        step[index] = _STEP * max(1.0, abs(parameters[index]))
        ends = [_with_parameters(lens, parameters + sign * step).project(local) for sign in (1, -1)]
        slopes.append((ends[0] - ends[1]) / (2 * step[index]))
    return np.stack(slopes, axis=2).reshape(-1, 9)


def _with_parameters(lens: Lens, parameters: Array) -> Lens:
    fx, fy, cx, cy = parameters[:4]
    return Lens(lens.width, lens.height, np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]]), parameters[4:])


def _collected(
    cameras: Sequence[str],
    state: _State,
    seen: Sequence[_Seen],
    lenses: Sequence[Lens],
    lens_covariance: Mapping[str, Array],
) -> Poses:
    """The poses, in the frame of the first camera."""
    turn, centre = state.turns[0], state.centres[0]
    w2c = {}
    for c, camera in enumerate(cameras):
        matrix = np.eye(4)
        matrix[:3, :3] = state.turns[c] @ turn.T
        matrix[:3, 3] = -state.turns[c] @ (state.centres[c] - centre)
        w2c[camera] = matrix
    distances = np.concatenate([np.linalg.norm(_residuals(state, s, lenses), axis=1) for s in seen])
    corners: dict[tuple[int, bytes], Array] = {}
    for s in seen:
        about, _ = _local(state, s)
        for printed, point in zip(s.points, about + state.board_places[s.instant]):
            corners[s.instant, printed.tobytes()] = turn @ (point - centre)
    points = np.array(list(corners.values()))
    numbers = {camera: c for c, camera in enumerate(cameras)}
    sigmas = _deviations(state, seen, lenses, {numbers[camera]: matrix for camera, matrix in lens_covariance.items()})

    def by_camera(figures: tuple[Array, Array] | None, which: int, column: int, factor: float) -> dict[str, float]:
        if figures is None:
            return {}
        return {camera: factor * float(figures[which][c, column]) for c, camera in enumerate(cameras)}

    degrees = float(np.degrees(1.0))
    return Poses(
        w2c=w2c,
        sweep_w2c=np.zeros((0, 4, 4)),
        sweep_indices=(),
        sweep_lens=Lens(1, 1, np.eye(3), np.zeros(5)),
        n_sweep=0,
        points=points,
        colours=np.full_like(points, 0.5),
        mean_error_px=float(distances.mean()),
        rms_error_px=float(np.sqrt((distances**2).mean())),
        n_observations=len(distances),
        centre_sigma=by_camera(sigmas, 0, 1, 1.0),
        rotation_sigma_deg=by_camera(sigmas, 0, 0, degrees),
        feature_centre_sigma=by_camera(sigmas, 1, 1, 1.0),
        feature_rotation_sigma_deg=by_camera(sigmas, 1, 0, degrees),
        attempts=(f"board seen by several cameras in {len({s.instant for s in seen})} instants",),
        metres_per_unit=1.0,
    )
