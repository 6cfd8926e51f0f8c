"""Importers that behave and misbehave, of what external_code.py writes. Given to `run` as FILE.py:CLASS."""

import json
from pathlib import Path

import numpy as np

from splashbench.errors import SplashbenchError
from splashbench.files import read_json
from splashbench.harness.contract import Fitted, Render
from splashbench.harness.external.importers import Importer
from splashbench.scene import Camera, Particles, TrainingScene


class _Flat(Fitted):
    """The mean colour everywhere, and the time as opacity."""

    def __init__(self, colour: list[float], span: float) -> None:
        self.colour, self.span = colour, span

    def render(self, camera: Camera, time: float) -> Render:
        size = (camera.height, camera.width)
        rgb = np.broadcast_to(np.asarray(self.colour, np.float32) / 255, (*size, 3))
        return Render(rgb, np.full(size, time / self.span, np.float32))

    def particles(self) -> Particles | None:
        return None

    def save(self, directory: Path) -> None:
        (directory / "imported.json").write_text(json.dumps([self.colour, self.span]))


class Colours(Importer):
    """Reads model.json."""

    id, title, formats = "colours", "mean colours", ("blender",)

    def read(self, output: Path, export: Path, scene: TrainingScene) -> Fitted:
        facts = read_json(export / "splashbench.json")
        assert (facts["format"], facts["test_images"]) == ("blender", "none")
        assert sorted(path.name for path in (scene.directory / "ims").iterdir()) == list(scene.train)
        return _Flat(read_json(output / "model.json")["colour"], facts["time_span_seconds"])

    def load(self, directory: Path, scene: TrainingScene) -> Fitted:
        return _Flat(*read_json(directory / "imported.json"))


class Refuses(Colours):
    """Does not find its files."""

    def read(self, output: Path, export: Path, scene: TrainingScene) -> Fitted:
        raise SplashbenchError("point_cloud.ply is missing; let the code save its last iteration")


class NotFinite(Colours):
    """NaN everywhere."""

    def load(self, directory: Path, scene: TrainingScene) -> Fitted:
        return _Flat([np.nan] * 3, 1.0)
