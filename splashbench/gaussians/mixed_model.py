"""A fitted model in which background and liquid are one set of Gaussians: its renders, and the liquid among them.

The liquid is what the silhouettes allow (observe/consistency.py): its Gaussians alone give the opacity of the liquid,
and its positions are the particles. The training masks say so when the model is loaded, not while it is fitted.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from splashbench.background.depth import common_target
from splashbench.errors import SplashbenchError, one_line
from splashbench.files import atomic_path, read_npz
from splashbench.gaussians.dynamic_model import DynamicModel, Splats
from splashbench.gaussians.fitting import FitHistory
from splashbench.gaussians.photographs import unit_time
from splashbench.gaussians.torch_threads import one_torch_thread
from splashbench.harness.contract import Fitted, Render
from splashbench.observe.consistency import silhouette_consistent
from splashbench.render import counters, rasterize
from splashbench.render.constants import MIN_ALPHA
from splashbench.scene import Camera, Gaussians, Particles, TrainingScene, look_at

MODEL_FILE = "model.npz"
_HISTORY_FILE = "history.json"


class _Masked:
    """The masks of `scene` as `cameras` see them, see observe.silhouettes.MaskedScene."""

    def __init__(self, scene: TrainingScene, cameras: dict[str, Camera]) -> None:
        self.name, self.train, self.n_frames, self.cameras = scene.name, scene.train, scene.n_frames, cameras
        self.mask = scene.mask


class MixedFitted(Fitted):
    """`model`, fitted to `scene`."""

    def __init__(self, model: DynamicModel, scene: TrainingScene, history: FitHistory | None = None) -> None:
        self.model, self.scene, self.history = model.eval(), scene, history
        self._liquid: dict[int, NDArray[np.bool_]] = {}
        self._masked = _Masked(scene, {name: self.lens(camera) for name, camera in scene.cameras.items()})

    def model_time(self, seconds: float, camera: Camera | None = None) -> float:
        """`seconds` of the scene's clock as the model takes times; `camera` that took the photograph, if one did."""
        return unit_time(self.scene, seconds)

    def lens(self, camera: Camera) -> Camera:
        """`camera` as the model was fitted with it."""
        return camera

    @torch.no_grad()
    def render(self, camera: Camera, time: float) -> Render:
        unit, camera = self.model_time(time, camera), self.lens(camera)
        with one_torch_thread():
            splats = self.model.splats(self.model.at(unit), camera)
            image = self.model.view(splats, camera, unit).clamp(0, 1).cpu().numpy()
        liquid = self._of_splats(self.liquid(int(np.abs(self.scene.times - time).argmin())), splats)
        chosen = torch.from_numpy(liquid).to(self.model.device)
        means, factors, opacities = (t[chosen] for t in (splats.means, splats.factors, splats.opacities))
        with counters.uncounted():  # asked for by the protocol, no part of the method's image
            _, alpha = rasterize(means, factors, opacities, None, camera)
        return Render(image, alpha.cpu().numpy())

    def to_device(self, device: str) -> None:
        self.model.to(device)

    @staticmethod
    def _of_splats(values: NDArray[np.bool_], splats: Splats) -> NDArray[np.bool_]:
        """Of `values`, one for each of the model's Gaussians, those of `splats`."""
        return values if splats.rows is None else values[splats.rows.cpu().numpy()]

    def liquid(self, t: int) -> NDArray[np.bool_]:
        """bool [N]: the Gaussians that the silhouettes of timestep `t` allow to be liquid."""
        if t not in self._liquid:
            # A silhouette is of its photograph's own instant.
            times = {
                name: self.model_time(float(self.scene.camera_times[name][t]), self.scene.cameras[name])
                for name in self.scene.train
            }
            means = {time: self._means(time) for time in set(times.values())}
            seen = {name: means[time] for name, time in times.items()}
            self._liquid[t] = silhouette_consistent(seen, self._masked, t)
        return self._liquid[t]

    @torch.no_grad()
    def _means(self, time: float) -> NDArray[np.float32]:
        """Means [N, 3] of all Gaussians at the model's `time`."""
        with one_torch_thread():
            return np.asarray(self.model.means(time).cpu().numpy())

    @torch.no_grad()
    def _drawn(self, t: int, count: int) -> NDArray[np.bool_]:
        """bool [count]: which of all Gaussians are drawn at all in some training view at timestep `t`."""
        drawn = np.zeros(count, bool)
        with one_torch_thread():
            state = self.model.at(self.model_time(float(self.scene.times[t])))
            for camera in self._masked.cameras.values():
                splats = self.model.splats(state, camera)
                rows = slice(None) if splats.rows is None else splats.rows.cpu().numpy()
                drawn[rows] |= splats.opacities.cpu().numpy() >= MIN_ALPHA
        return drawn

    def particles(self) -> Particles | None:
        steps = range(self.scene.n_frames)
        active = np.stack([liquid & self._drawn(t, len(liquid)) for t, liquid in ((t, self.liquid(t)) for t in steps)])
        ever = active.any(axis=0)
        times = [self.model_time(float(seconds)) for seconds in self.scene.times]
        return Particles(np.stack([self._means(time)[ever] for time in times]), active[:, ever])

    def gaussians(self, time: float, eye: NDArray) -> Gaussians:
        """Those of the liquid, as the silhouettes of the nearest timestep say."""
        return self._apart(time, eye, liquid=True)

    def static_gaussians(self, eye: NDArray) -> Gaussians:
        """Those that are not the liquid's, as they are at the first timestep: nothing is apart in such a model."""
        return self._apart(float(self.scene.times[0]), eye, liquid=False)

    @torch.no_grad()
    def _apart(self, time: float, eye: NDArray, liquid: bool) -> Gaussians:
        camera = self.lens(self._wide_camera(eye))
        with one_torch_thread():
            splats = self.model.splats(self.model.at(self.model_time(time)), camera)
            colors = self.model.colors(splats).clamp(0, 1)
        chosen = self._of_splats(self.liquid(int(np.abs(self.scene.times - time).argmin())), splats)
        parts = (splats.means, splats.factors, splats.opacities, colors)
        return Gaussians(*(part.cpu().numpy()[chosen == liquid] for part in parts))

    def _wide_camera(self, eye: NDArray) -> Camera:
        """A camera at `eye` that nearly everything before it is seen by: models leave out what none could see."""
        cameras = list(self.scene.cameras.values())
        up = -np.mean([camera.w2c[1, :3] for camera in cameras], axis=0)
        return Camera(
            "eye",
            512,
            512,
            np.array([[40.0, 0, 256], [0, 40, 256], [0, 0, 1]]),
            look_at(eye, common_target(cameras), up),
        )

    def save(self, directory: Path) -> None:
        arrays = {name: tensor.detach().cpu().numpy() for name, tensor in self.model.state_dict().items()}
        if self.model.backdrop is not None:
            arrays["backdrop"] = self.model.backdrop.cpu().numpy()
        with atomic_path(directory / MODEL_FILE) as temporary, temporary.open("wb") as stream:
            np.savez(stream, allow_pickle=False, **arrays)
        if self.history is not None:
            steps = np.array_split(self.history.psnr, min(100, len(self.history.psnr)))
            facts = {
                "training_psnr": [round(float(part.mean()), 4) for part in steps],
                "gained_in_last_quarter": round(self.history.gained_in_last_quarter(), 4),
            }
            with atomic_path(directory / _HISTORY_FILE) as temporary:
                temporary.write_text(json.dumps(facts) + "\n", encoding="utf-8")


def load_tables(model_file: Path, model: DynamicModel, rows: tuple[str, ...]) -> None:
    """Fill `model` with what `MixedFitted.save` wrote; tables `rows` may have any number of rows, the same for all.

    Raises SplashbenchError where the file does not go with the model.
    """
    shapes = {name: tensor.ndim for name, tensor in model.state_dict().items()}
    arrays = read_npz(model_file, shapes, {"backdrop": 1})
    count = len(arrays[rows[0]])
    for name in rows:
        old = getattr(model, name)
        blank = torch.zeros(count, *old.shape[1:])
        setattr(model, name, torch.nn.Parameter(blank) if isinstance(old, torch.nn.Parameter) else blank)
    if "backdrop" in arrays:
        if arrays["backdrop"].shape != (3,):
            raise SplashbenchError(f"{model_file}: the backdrop is no colour; fit again")
        model.backdrop = torch.from_numpy(arrays["backdrop"].astype(np.float32))
    try:
        model.load_state_dict({name: torch.from_numpy(arrays[name]) for name in shapes})
    except RuntimeError as error:
        cause = one_line(str(error))
        raise SplashbenchError(f"{model_file} does not go with this method ({cause}); fit again") from None
