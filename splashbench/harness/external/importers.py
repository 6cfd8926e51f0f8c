"""Importers: what an external code wrote, read as a fitted model that the harness renders, times and checks itself.

An importer knows the files of one code, and has its primitives and their renderer in Python. It is registered under the
entry-point group `splashbench.importers`, or given as FILE.py:CLASS. docs/external_methods.md has an example.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from importlib.metadata import entry_points
from pathlib import Path
from typing import ClassVar

from splashbench.errors import SplashbenchError
from splashbench.harness.contract import Fitted
from splashbench.harness.discovery import class_from_file, load_point
from splashbench.scene import TrainingScene

GROUP = "splashbench.importers"


class Importer(ABC):
    """Reads the output of one code. Files come from elsewhere: no pickles, torch.load with weights_only=True."""

    id: ClassVar[str]
    title: ClassVar[str]
    #: Formats of `scene export` that the code trains on; its output is in their coordinates and times.
    formats: ClassVar[tuple[str, ...]]
    #: True where one set of primitives holds background and liquid, as `Method.mixed`; no --mixed is needed then.
    mixed: ClassVar[bool] = False

    @abstractmethod
    def read(self, output: Path, export: Path, scene: TrainingScene) -> Fitted:
        """The model in `output`, the folder `{out}` of the command, in the scene's own units and seconds.

        export: the scene as the code saw it, with splashbench.json (and for nerfies scene.json: center, scale).
        Raises SplashbenchError for files that are missing or not what the code writes.
        """

    @abstractmethod
    def load(self, directory: Path, scene: TrainingScene) -> Fitted:
        """Read what `Fitted.save` wrote of a model that `read` gave, in a fresh process; see `Method.load`."""


def registered_importers() -> list[str]:
    """Ids of the importers installed, sorted; nothing is imported."""
    return sorted(point.name for point in entry_points(group=GROUP))


def load_importer(name: str) -> Importer:
    """The importer registered as `name`, or `FILE.py:CLASS`. Raises SplashbenchError when there is none."""
    if ":" in name:
        importer = class_from_file(name)
    else:
        points = {point.name: point for point in entry_points(group=GROUP)}
        if name not in points:
            installed = ", ".join(sorted(points)) or "none"
            raise SplashbenchError(
                f"there is no importer {name!r} (installed: {installed}); give --render-command, or an importer as "
                "FILE.py:CLASS (docs/external_methods.md)"
            )
        importer = load_point(points[name])
    if not (isinstance(importer, type) and issubclass(importer, Importer)):
        raise SplashbenchError(f"{name!r} is not a splashbench.harness.external.importers.Importer; subclass it")
    missing = sorted(getattr(importer, "__abstractmethods__", ()))
    missing += [attribute for attribute in ("id", "title", "formats") if not hasattr(importer, attribute)]
    if missing:
        raise SplashbenchError(f"importer {name!r} lacks {', '.join(missing)}; see docs/external_methods.md")
    return importer()
