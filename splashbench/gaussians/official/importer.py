"""What the official codes of the baselines have in common, for importers of their output.

They draw with the rasterizer of 3D Gaussian splatting (Kerbl et al. 2023) or one made from it, which leaves out what
lies nearer than 0.2 of the code's own units, and draws over a plain background. They keep their own clock, and some of
them their own idea of a lens. `OfficialModel` adds these to a model of ours, `OfficialFitted` renders by them. Two
differences stay: there alpha ends at 0.99, here at 0.999, and there a Gaussian ends with the tiles that a square of
3 sigma touches.

An output folder holds `point_cloud/iteration_N/point_cloud.ply` and `cfg_args`, the arguments of the training as Python
would print them.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from splashbench.errors import SplashbenchError
from splashbench.files import require_plain_file
from splashbench.gaussians.mixed import MixedFitted
from splashbench.gaussians.splats import DynamicModel, Splats
from splashbench.render import rasterize
from splashbench.scene import Camera, TrainingScene

NEAR = 0.2
_ITERATION = re.compile(r"iteration_(\d{1,9})")
_ARGUMENT = re.compile(r"(\w+)=('(?:[^'\\]|\\.)*'|\"(?:[^\"\\]|\\.)*\"|[^,()'\"\[\]]+)")
_MAX_ARGUMENTS_BYTES = 1 << 16


class OfficialModel(DynamicModel):
    """To be put before a model of ours among the bases of a class; its `at` takes times of the code's clock."""

    near: Tensor
    background: Tensor
    clock: Tensor

    def __init__(self, *arguments: object) -> None:
        super().__init__(*arguments)
        # Depth up to which nothing is drawn, scene units; behind everything, [3]; origin and unit of the clock.
        self.register_buffer("near", torch.tensor(NEAR))
        self.register_buffer("background", torch.zeros(3))
        self.register_buffer("clock", torch.tensor([0.0, 1.0], dtype=torch.float64))

    def own_time(self, seconds: float, camera: Camera | None, scene: TrainingScene) -> float:
        """`seconds` of the scene's clock on the code's; camera: that took the photograph, None for all together."""
        origin, unit = self.clock.tolist()
        return (seconds - origin) / unit

    def lens(self, camera: Camera) -> Camera:
        """`camera` as the code takes it: of the same image size and pose."""
        return camera

    def splats(self, state: Any, camera: Camera) -> Splats:
        """As of the model beneath, without opacity where the published rasterizer draws nothing."""
        splats = super().splats(state, camera)  # type: ignore[safe-super]
        axis = torch.tensor(camera.w2c[2], dtype=torch.float32)
        splats.opacities = splats.opacities * (splats.means @ axis[:3] + axis[3] > self.near)
        return splats

    def view(self, splats: Splats, camera: Camera, time: float) -> Tensor:
        background = self.background if splats.colors.shape[1] == 3 else None
        rendered, _ = rasterize(
            splats.means, splats.factors, splats.opacities, splats.colors, camera, background=background
        )
        return self.image(rendered, camera, time)


class OfficialFitted(MixedFitted):
    """An official code's model: rendered by its own clock and lenses."""

    model: OfficialModel

    def model_time(self, seconds: float, camera: Camera | None = None) -> float:
        return self.model.own_time(seconds, camera, self.scene)

    def lens(self, camera: Camera) -> Camera:
        return self.model.lens(camera)


def require_finite(fitted: OfficialFitted, path: Path) -> OfficialFitted:
    """`fitted` itself. Raises SplashbenchError, naming `path`, where its Gaussians come to nothing at either end."""
    with torch.no_grad():
        for seconds in fitted.scene.times[[0, -1]]:
            time = fitted.model_time(float(seconds))
            for camera in list(fitted.scene.cameras.values())[:1]:
                splats = fitted.model.splats(fitted.model.at(time), fitted.lens(camera))
                found = {name: getattr(splats, name) for name in ("means", "factors", "opacities", "colors")}
                for name, values in [("means", fitted.model.means(time)), *found.items()]:
                    if not torch.isfinite(values).all():
                        raise SplashbenchError(
                            f"{path}: {name} of the Gaussians overflow at {seconds:g} s; the fit failed, repeat it"
                        )
    return fitted


def last_iteration(folder: Path) -> int:
    """The largest N of the folders `folder`/iteration_N. Raises SplashbenchError where there is none."""
    found = [_ITERATION.fullmatch(path.name) for path in folder.iterdir()] if folder.is_dir() else []
    numbers = [int(match[1]) for match in found if match]
    if not numbers:
        raise SplashbenchError(f"{folder} holds no iteration_<n>; let the code save its last iteration")
    return max(numbers)


def last_point_cloud(output: Path) -> Path:
    """point_cloud/iteration_N/point_cloud.ply of the last iteration that was saved in `output`."""
    folder = output / "point_cloud"
    return folder / f"iteration_{last_iteration(folder)}" / "point_cloud.ply"


@dataclass(frozen=True)
class Arguments:
    """cfg_args of an output folder: values as they are printed, by name. path: of the file, for messages."""

    path: Path
    values: dict[str, str]

    @classmethod
    def read(cls, output: Path) -> Arguments:
        """Those of `output`; none where the file is missing."""
        path = output / "cfg_args"
        if not path.exists():
            return cls(path, {})
        require_plain_file(path)
        if path.stat().st_size > _MAX_ARGUMENTS_BYTES:
            raise SplashbenchError(f"{path} is larger than {_MAX_ARGUMENTS_BYTES >> 10} KiB; give the code's own file")
        text = path.read_text(encoding="utf-8", errors="replace")
        if not text.lstrip().startswith("Namespace("):
            raise SplashbenchError(f"{path} does not begin with Namespace(; give the file as the code wrote it")
        return cls(path, {match[1]: match[2].strip() for match in _ARGUMENT.finditer(text)})

    def text(self, name: str, default: str | None = None) -> str:
        """The text `name`; `default` where there is none, or an error without one."""
        value = self._value(name, default)
        return value[1:-1] if value[:1] in ("'", '"') else value

    def number(self, name: str, default: float | None = None) -> float:
        """The finite number `name`."""
        value = self._value(name, None if default is None else repr(default))
        try:
            number = float(value)
        except ValueError:
            number = np.nan
        if not np.isfinite(number):
            raise SplashbenchError(f"{self.path}: {name} is {value[:40]}, not a number; give the code's own file")
        return number

    def flag(self, name: str) -> bool:
        """Whether the option `name` was given."""
        return self._value(name, "False") == "True"

    def _value(self, name: str, default: str | None) -> str:
        value = self.values.get(name, default)
        if value is None:
            raise SplashbenchError(
                f"{self.path} {'lacks ' + name if self.values else 'is missing'}; keep it beside point_cloud, as the "
                "code wrote it"
            )
        return value
