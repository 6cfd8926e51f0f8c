"""The static background as a library: fit it, render it, keep it (paper: pretrained per scene, then frozen)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from splashbench_methods.scaffold_gs.anchors import seed_anchors
from splashbench_methods.scaffold_gs.fitting import fit_model, supervised_anchors
from splashbench_methods.scaffold_gs.model import AnchorModel, to_arrays
from splashbench_methods.scaffold_gs.plate import Plate, make_plate
from splashbench_methods.scaffold_gs.settings import BackgroundSettings

from splashbench.adapter.contract import Run
from splashbench.errors import SplashbenchError
from splashbench.files import atomic_path, read_npz
from splashbench.render import rasterize_arrays
from splashbench.render.torch_threads import one_torch_thread
from splashbench.scene import Camera, TrainingScene

_FILE = "background.npz"


class Background:
    """A fitted static scene. `far_color` [3] is what shows where no Gaussian lies."""

    def __init__(self, model: AnchorModel, far_color: NDArray[np.float32]) -> None:
        self.model = model.eval()
        self.far_color = np.asarray(far_color, dtype=np.float32)

    def gaussians(self, camera: Camera) -> tuple[NDArray, NDArray, NDArray, NDArray]:
        """Means [M, 3], factors [M, 3, 3], opacities [M] and colors [M, 3] as seen from `camera`, float32."""
        with torch.no_grad(), one_torch_thread():
            means, factors, opacities, colors, _ = self.model.decode(camera.center)
        return means.numpy(), factors.numpy(), opacities.numpy(), colors.numpy()

    def render(self, camera: Camera) -> NDArray[np.float32]:
        """The liquid-free view of `camera`, float32 [H, W, 3] in [0, 1]."""
        rgb, _ = rasterize_arrays(*self.gaussians(camera), camera, background=self.far_color)
        return np.clip(rgb, 0, 1)

    def save(self, directory: Path) -> None:
        """Write background.npz into `directory` (made where absent)."""
        fixed = {
            "children": np.array(self.model.children_per_anchor),
            "view_dependent_shape": np.array(self.model.view_dependent_shape),
            "far_color": self.far_color,
        }
        with atomic_path(Path(directory) / _FILE) as temporary, temporary.open("wb") as stream:
            np.savez(stream, allow_pickle=False, **fixed, **to_arrays(self.model))

    @classmethod
    def load(cls, directory: Path) -> Background:
        """Read what `save` wrote."""
        path = Path(directory) / _FILE
        fixed = read_npz(path, {"children": 0, "view_dependent_shape": 0, "far_color": 1, "positions": 2})
        n, children = len(fixed["positions"]), int(fixed["children"])
        if not 1 <= children <= 1024:
            raise SplashbenchError(f"{path}: {children} children per anchor make no sense; fit the background again")
        model = AnchorModel(n, children, bool(fixed["view_dependent_shape"]))
        state = model.state_dict()
        arrays = read_npz(path, {name: tensor.ndim for name, tensor in state.items()})
        try:
            model.load_state_dict({name: torch.as_tensor(array) for name, array in arrays.items()})
        except RuntimeError:
            raise SplashbenchError(f"{path}: its arrays do not fit together; fit the background again") from None
        return cls(model, fixed["far_color"])


def fit_background(
    scene: TrainingScene, settings: BackgroundSettings, run: Run, span: tuple[float, float] = (0.0, 1.0)
) -> Background:
    """Fit the static scene behind the liquid to the training views' plates. The same seed gives the same background.

    `span` is the part of `run`'s progress that this takes up, for callers with more to do.
    """

    def progress(fraction: float, message: str) -> None:
        run.progress(span[0] + (span[1] - span[0]) * fraction, message)

    plates: list[Plate] = []
    for i, name in enumerate(scene.train):
        progress(0.05 * i / len(scene.train), "liquid-free plates")
        plates.append(make_plate(scene, name, settings.longest_side))
    colors = np.concatenate([plate.image[plate.seen] for plate in plates])
    if not len(colors):
        raise SplashbenchError(f"{scene.directory}: liquid masks cover every training view throughout; mend the masks")
    far_color = np.median(colors, axis=0)
    progress(0.05, "depths of the background")
    seed = seed_anchors(scene.initial_points(), plates, settings.anchors, np.random.default_rng(run.seed))
    with one_torch_thread():
        model = fit_model(seed, plates, settings, far_color, run.seed, lambda f: progress(0.1 + 0.9 * f, "background"))
        return Background(supervised_anchors(model, plates), far_color)
