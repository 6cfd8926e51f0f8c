"""Submissions held in memory: scoring depends on nothing but their attributes."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from splashbench.scene import Particles, Scene, SignedDistance

_COSTS = ("fit_seconds", "render_fps", "peak_memory_bytes", "peak_device_memory_bytes", "storage_bytes")
_COSTS += ("dynamic_bytes", "primitives_per_frame", "particles_per_frame")


@dataclass
class FakeSubmission:
    """The ground truth as a submission, or what `change(rgb, alpha, t)` makes of it."""

    scene: Scene
    method: str = "fake"
    control: bool = False
    mixed: bool = False
    seed: int = 0
    status: str = "ok"
    reason: str = ""
    particle_set: Particles | None = None
    signed_distance: SignedDistance | None = None
    change: Callable[[np.ndarray, np.ndarray, int], tuple[np.ndarray, np.ndarray]] | None = None
    scene_digest: str | None = None

    @property
    def identity(self) -> SimpleNamespace:
        return SimpleNamespace(
            method=self.method,
            method_version="1",
            preset="best",
            settings={"iterations": 10},
            overrides=["iterations=10"],
            seed=self.seed,
            scene=self.scene.name,
            scene_digest=self.scene_digest or self.scene.digest,
            told=None,
            control=self.control,
            mixed=self.mixed,
            withheld=None,
            claimed={},
            hardware={"cpu": "test processor", "cores": 2},
        )

    @property
    def record(self) -> SimpleNamespace:
        measured = {"fit_seconds": 12.5, "peak_memory_bytes": 1 << 20} if self.status == "ok" else {}
        return SimpleNamespace(**(dict.fromkeys(_COSTS) | measured), checkpoints=[], stages={}, notes={}, decisions=[])

    @property
    def digest(self) -> str:
        return f"{self.seed:064x}"

    def _view(self, camera: str, t: int) -> tuple[np.ndarray, np.ndarray]:
        assert self.status == "ok", "a failed submission has no renders to look at"
        rgb, alpha = self.scene.image(camera, t).copy(), self.scene.mask(camera, t).astype(np.float32)
        return self.change(rgb, alpha, t) if self.change else (rgb, alpha)

    def rendering(self, camera: str, t: int) -> np.ndarray:
        return self._view(camera, t)[0]

    def alpha(self, camera: str, t: int) -> np.ndarray:
        return self._view(camera, t)[1]

    def particles(self) -> Particles | None:
        return self.particle_set

    def geometry(self) -> SignedDistance | None:
        return self.signed_distance


@pytest.fixture
def fake() -> type[FakeSubmission]:
    return FakeSubmission


@pytest.fixture
def quiet() -> Callable[[Iterable[Any], str], Iterator[Any]]:
    """A `track` without a bar."""
    return lambda iterable, description: iter(iterable)


@pytest.fixture(autouse=True)
def _no_weights_from_outside(monkeypatch: pytest.MonkeyPatch) -> None:
    """LPIPS weights only where a test asks for them."""
    monkeypatch.delenv("SPLASHBENCH_LPIPS_WEIGHTS", raising=False)
