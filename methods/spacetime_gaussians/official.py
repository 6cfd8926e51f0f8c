"""Models of the official SpacetimeGaussians (oppo-us-research), full and lite, drawn as that code draws them.

It leaves point_cloud/iteration_N/point_cloud.ply, for the full model the decoder beside it in point_cloud.pt, and
cfg_args. A full cloud has 38 numbers per Gaussian, a lite one 32. Against spacetime_gaussians:

    time is (timestep - first) / duration, whenever the photograph was taken
    the decoder ends in a sigmoid (`sandwich`), or clamped to [0, 1] (`sandwichnoact`)
    behind a lite model there may be white
    the loader `colmap` puts principal points in the middle; the others do so where cy is in the middle
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor, nn

from splashbench.errors import SplashbenchError
from splashbench.files import read_npz
from splashbench.files.ply import PointCloud, read_point_cloud
from splashbench.gaussians.mixed_model import MODEL_FILE, load_tables
from splashbench.gaussians.official.checkpoint import fill, read_weights
from splashbench.gaussians.official.model import OfficialFitted, OfficialModel, require_finite
from splashbench.gaussians.official.output_folder import TrainingArguments, last_point_cloud
from splashbench.harness.external.importers import Importer
from splashbench.scene import Camera, TrainingScene

from .model import SpacetimeModel

_SIGMOID = {"sandwich": True, "sandwichnoact": False}
_FIRST = re.compile(r"colmap_(\d{1,9})")


class OfficialSpacetime(OfficialModel, SpacetimeModel):
    """N Gaussians of the official code; times in durations, the clock's unit in timesteps."""

    sigmoid: Tensor
    centered: Tensor

    def __init__(self, n: int, full: bool) -> None:
        super().__init__(n, full)
        self.register_buffer("sigmoid", torch.tensor(True))
        self.register_buffer("centered", torch.tensor(False))

    def own_time(self, seconds: float, camera: Camera | None, scene: TrainingScene) -> float:
        times = scene.times if camera is None else scene.camera_times.get(camera.name, scene.times)
        first, duration = self.clock.tolist()
        return (_index(times, seconds) - first) / duration

    def lens(self, camera: Camera) -> Camera:
        # Where cy is in the middle the code takes cx for that too.
        if not self.centered and camera.K[1, 2] / camera.height != 0.5:
            return camera
        K = camera.K.copy()
        K[:2, 2] = camera.width / 2, camera.height / 2
        return replace(camera, K=K)

    def image(self, rendered: Tensor, camera: Camera, time: float) -> Tensor:
        if self.full and not self.sigmoid:
            return self.decoded(rendered, camera)
        return super().image(rendered, camera, time)


def _index(times: np.ndarray, seconds: float) -> float:
    """Which of `times` [T], rising, `seconds` is: between two of them a fraction, beyond the ends in the last step."""
    if len(times) < 2:
        return 0.0
    i = int(np.clip(np.searchsorted(times, seconds, side="right") - 1, 0, len(times) - 2))
    step = float(times[i + 1] - times[i])
    return i + (seconds - float(times[i])) / step if step > 0 else float(i)


class OfficialSpacetimeGaussians(Importer):
    """Reads what `train.py --source_path {scene}/colmap_0 --model_path {out}` leaves in {out}."""

    id: ClassVar[str] = "spacetime_gaussians"
    title: ClassVar[str] = "SpacetimeGaussians, the official code's models, full and lite"
    formats: ClassVar[tuple[str, ...]] = ("colmap",)
    mixed: ClassVar[bool] = True

    def read(self, output: Path, export: Path, scene: TrainingScene) -> OfficialFitted:
        path, arguments = last_point_cloud(output), TrainingArguments.read(output)
        model = _gaussians(read_point_cloud(path))
        duration, loader = arguments.number("duration"), arguments.text("loader")
        if duration < 1:
            raise SplashbenchError(f"{arguments.path}: duration is {duration:g}, no number of timesteps; train again")
        first = _FIRST.match(Path(arguments.text("source_path")).name)
        model.clock.copy_(torch.tensor([int(first[1]) if first else 0, duration], dtype=torch.float64))
        model.centered.fill_(loader.startswith("colmap"))
        white = arguments.flag("white_background")
        if white and model.full:
            raise SplashbenchError(
                f"{arguments.path}: white_background, of which that code takes three channels for the full model's "
                "nine; train without it"
            )
        model.background.fill_(float(white))
        if model.full:
            decoder = arguments.text("rgbfunction")
            if decoder not in _SIGMOID:
                decoders = " or ".join(_SIGMOID)
                raise SplashbenchError(f"{arguments.path}: rgbfunction is {decoder[:40]!r}; train with {decoders}")
            model.sigmoid.fill_(_SIGMOID[decoder])
            weights = path.with_suffix(".pt")
            # Convolutions of one pixel.
            layers = {"mlp1.weight": model.decoder[0].weight, "mlp2.weight": model.decoder[2].weight}
            fill({name: layer[:, :, None, None] for name, layer in layers.items()}, read_weights(weights), weights)
        return require_finite(OfficialFitted(model, scene), path)

    def load(self, directory: Path, scene: TrainingScene) -> OfficialFitted:
        path = directory / MODEL_FILE
        model = OfficialSpacetime(0, full="features" in read_npz(path, {}, {"features": 2}))
        load_tables(path, model, model.rows)
        return OfficialFitted(model, scene)


def _gaussians(cloud: PointCloud) -> OfficialSpacetime:
    """The cloud's Gaussians; the decoder's weights are still to come."""
    full = cloud.count("f_dc_") > 3
    model = OfficialSpacetime(len(cloud), full)
    channels = cloud.numbered("f_dc_", 6 if full else 3)
    tables = {
        "positions": cloud.table("x", "y", "z"),
        "motions": cloud.numbered("motion_", 9).reshape(-1, 3, 3),  # by power, then axis
        "log_scales": cloud.numbered("scale_", 3),
        "quaternions": cloud.numbered("rot_", 4),
        "spins": cloud.numbered("omega_", 4),
        "opacity_logits": cloud.table("opacity")[:, 0],
        "times": cloud.table("trbf_center")[:, 0],
        "log_widths": cloud.table("trbf_scale")[:, 0],
        "base": channels[:, :3],
    }
    if full:
        tables |= {"features": channels[:, 3:], "time_features": cloud.numbered("f_t_", 3)}
    for name, table in tables.items():
        setattr(model, name, nn.Parameter(torch.from_numpy(np.ascontiguousarray(table))))
    return model
