"""The static background as a library: fit it, render it, keep it (paper: pretrained per scene, then frozen)."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from splashbench.background.clean_plate import MAX_FRAMES, CleanPlate, make_clean_plate, make_clean_plates
from splashbench.errors import SplashbenchError
from splashbench.files import compressed_bytes, read_npz, write_npz
from splashbench.gaussians.anchor_seeds import AnchorSeed, seed_anchors, sparse_anchors
from splashbench.gaussians.initialization import hull_points
from splashbench.gaussians.torch_threads import one_torch_thread
from splashbench.harness.contract import Run
from splashbench.render import rasterize_arrays
from splashbench.scene import Camera, TrainingScene

from .fitting import fit_model, supervised_anchors
from .model import AnchorModel, StaticAnchorSpec, from_arrays, round_to_stored, to_arrays
from .settings import BackgroundSettings

_FILE = "background.npz"
# Where Gaussians cover a pixel by less, there is nothing: a tail of one tells no depth.
_LEAST_OPACITY = 0.05


#: Training views without their liquid, by name.
Plates = Mapping[str, CleanPlate]


class Background:
    """A fitted static scene. `far_color` [3] is what shows where no Gaussian lies."""

    def __init__(self, model: AnchorModel, far_color: NDArray[np.float32]) -> None:
        # As it is stored: a saved background renders the same.
        self.model = round_to_stored(model.cpu()).eval()
        self.far_color = np.asarray(far_color, dtype=np.float32)

    def gaussians(self, camera: Camera) -> tuple[NDArray, NDArray, NDArray, NDArray]:
        """Means [M, 3], factors [M, 3, 3], opacities [M] in (0, 1] and colors [M, 3] seen from `camera`, float32."""
        return self.seen_from(camera.center)

    def seen_from(self, eye: NDArray) -> tuple[NDArray, NDArray, NDArray, NDArray]:
        """As `gaussians`, seen from `eye` [3] (scene units)."""
        with torch.no_grad(), one_torch_thread():
            means, factors, opacities, colors, _ = (t.numpy() for t in self.model.decode(eye))
        drawn = opacities > 0
        return means[drawn], factors[drawn], opacities[drawn], colors[drawn]

    def render(self, camera: Camera) -> NDArray[np.float32]:
        """The liquid-free view of `camera`, float32 [H, W, 3] in [0, 1]."""
        rgb, _ = rasterize_arrays(*self.gaussians(camera), camera, background=self.far_color)
        return np.clip(rgb, 0, 1)

    def seen_by(self, scene: TrainingScene) -> dict[str, NDArray[np.float32]]:
        """What the training views of `scene` show of it, float32 [H, W, 3] each; see `render`."""
        return dict(self.views(scene))

    def views(self, scene: TrainingScene) -> Iterator[tuple[str, NDArray[np.float32]]]:
        """The same one after the other: name and image of each view, which is rendered when it is asked for."""
        for name, camera in scene.cameras.items():
            yield name, np.asarray(self.render(camera), dtype=np.float32)

    def depth(self, camera: Camera) -> NDArray[np.float32]:
        """Expected depth along the optical axis of `camera`, float32 [H, W], scene units; inf where nothing lies.

        It is the mean over the Gaussians of a pixel, weighted as their colours are.
        """
        means, factors, opacities, _ = self.gaussians(camera)
        total, opacity = rasterize_arrays(means, factors, opacities, None, camera, depth=True)
        shown = opacity >= _LEAST_OPACITY
        depth = np.full(opacity.shape, np.inf, np.float32)
        depth[shown] = total[..., 0][shown] / opacity[shown]
        return depth

    def save(self, directory: Path) -> None:
        """Write background.npz into `directory` (made where absent)."""
        write_npz(Path(directory) / _FILE, self._arrays)

    @property
    def stored_bytes(self) -> int:
        """How much `save` writes, to within some kilobytes."""
        return compressed_bytes(self._arrays)

    @property
    def _arrays(self) -> dict[str, np.ndarray]:
        variant = {name: np.array(value) for name, value in vars(self.model.variant).items()}
        return {"far_color": self.far_color, **variant, **to_arrays(self.model)}

    @classmethod
    def load(cls, directory: Path) -> Background:
        """Read what `save` wrote."""
        path = Path(directory) / _FILE
        fixed = read_npz(
            path, {"children": 0, "view_dependent_shape": 0, "base_color": 0, "far_color": 1, "positions": 2}
        )
        n, children = len(fixed["positions"]), int(fixed["children"])
        if not 1 <= children <= 1024:
            raise SplashbenchError(f"{path}: {children} children per anchor make no sense; fit the background again")
        model = AnchorModel(
            n, StaticAnchorSpec(children, bool(fixed["view_dependent_shape"]), bool(fixed["base_color"]))
        )
        state = model.state_dict()
        arrays = read_npz(path, {name: tensor.ndim for name, tensor in state.items()})
        try:
            from_arrays(model, arrays)
        except RuntimeError:
            raise SplashbenchError(f"{path}: its arrays do not fit together; fit the background again") from None
        return cls(model, fixed["far_color"])


def fit_background(
    scene: TrainingScene,
    settings: BackgroundSettings,
    run: Run,
    span: tuple[float, float] = (0.0, 1.0),
    offer: Callable[[Callable[[], Background]], None] | None = None,
) -> Background:
    """Fit the static scene behind the liquid to the training views' plates. The same seed gives the same background.

    `span` is the part of `run`'s progress that this takes up, for callers with more to do. `offer` is given, after
    every step, what makes the background as if the fit ended there. Raises SplashbenchError where masks leave nothing
    to fit, or the anchors are to start from points and there are none, nor a hull.
    """
    fitting = "background"

    def progress(fraction: float, message: str) -> None:
        run.progress(span[0] + (span[1] - span[0]) * fraction, message)

    points = scene.initial_points()
    if settings.start == "points" and (points is None or not len(points)):
        fitting = "background, from points of the liquid's hull, as the scene has no sparse ones"
        progress(0, fitting)
        points = _hull_points(scene, settings.max_anchors)
    n_frames = 1 if settings.frames == "first" else MAX_FRAMES
    plates: list[CleanPlate] = []
    for i, name in enumerate(scene.train):
        progress(0.05 * i / len(scene.train), "liquid-free plates")
        plate = make_clean_plate(scene, name, settings.longest_side, n_frames, near_still=True)
        # A view that is liquid throughout says nothing, and has no loss.
        if plate.seen.any():
            plates.append(plate)
    if not plates:
        raise _covered(scene, "in frame 0" if settings.frames == "first" else "throughout")
    far_color = np.median(np.concatenate([plate.image[plate.seen] for plate in plates]), axis=0) / 255
    progress(0.05, "depths of the background")
    seed = _seed(points, [plate.without_beside() for plate in plates], settings, run.seed)

    def offered(model: AnchorModel) -> None:
        if offer is not None:
            offer(lambda: Background(supervised_anchors(model, plates), far_color))

    with one_torch_thread():
        model = fit_model(
            seed, plates, settings, far_color.astype(np.float32), run.seed,
            lambda fraction: progress(0.1 + 0.9 * fraction, fitting), offered, run.device,
        )  # fmt: skip
        return Background(supervised_anchors(model, plates), far_color)


def _covered(scene: TrainingScene, when: str) -> SplashbenchError:
    return SplashbenchError(f"{scene.directory}: liquid masks cover every training view {when}; fix the masks")


def clean_plates(scene: TrainingScene, n_frames: int = MAX_FRAMES) -> Plates:
    """The plate of every training view of `scene`, in its size, of at most `n_frames` frames.

    Raises SplashbenchError where masks cover everything in more than one frame.
    """
    plates = make_clean_plates(scene, n_frames)
    if n_frames > 1 and not any(plate.seen.any() for plate in plates.values()):
        raise _covered(scene, "throughout")
    return plates


def flat_background(plates: Plates) -> Background:
    """For who cannot wait: a background of one colour, the median of all that `plates` show."""
    seen = np.concatenate([plate.image[plate.seen] for plate in plates.values()])
    color = (np.median(seen, axis=0) / 255).astype(np.float32) if len(seen) else np.full(3, 0.5, np.float32)
    return Background(AnchorModel(0, StaticAnchorSpec(1)), color)


def completed(plates: Plates, background: Background) -> dict[str, NDArray[np.float32]]:
    """The views of `plates` with what `background` shows where they show nothing: float32 [H, W, 3] each."""
    return {
        name: np.where(plate.seen[..., None], plate.floats(), background.render(plate.camera))
        for name, plate in plates.items()
    }


def _hull_points(scene: TrainingScene, count: int) -> NDArray[np.float32]:
    """Some `count` points on the liquid's hull, all frames together: float32 [n, 6], positions and colours.

    The paper starts there on synthetic scenes, which have no sparse points (supplement, "Baselines").
    """
    hull = hull_points(scene, count)
    if not len(hull):
        path = scene.directory / "init_pt_cld.npz"
        raise SplashbenchError(
            f"{path} holds no points to start from, nor do the masks show liquid; add points, or set start=pixels"
        )
    return np.concatenate([hull.positions, hull.colors], axis=1)


def _seed(
    points: NDArray[np.float32] | None, plates: list[CleanPlate], settings: BackgroundSettings, random_seed: int
) -> AnchorSeed:
    if settings.start == "points":
        assert points is not None
        return sparse_anchors(points, settings.max_anchors)
    return seed_anchors(points, plates, settings.max_anchors, np.random.default_rng(random_seed))
