"""A ball of dyed liquid before a patterned wall, as light theory has it: what was filmed is known exactly."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from splashbench.dyes import Dye
from splashbench.harness.contract import Fitted, Render
from splashbench.replay import Reconstruction
from splashbench.replay.interface import cast
from splashbench.restyle.optics import facing, reflectance, seen_through, smoothed, transmittance
from splashbench.scene import Camera, SignedDistance, look_at
from splashbench.srgb import to_linear, to_srgb

VOXEL, RADIUS, ROOM = 0.004, 0.05, 0.3
OPAQUE = np.full(3, 1e9)


class Ball(Fitted):
    """`dye` per scene unit; `index` by which it bends light; gloss: a white highlight on it."""

    def __init__(self, dye: Dye, index: float = 1.0, gloss: float = 0.0) -> None:
        self.dye, self.index, self.gloss = dye, index, gloss

    def surface(self, time: float) -> SignedDistance:
        nodes = np.stack(np.meshgrid(*[(np.arange(40) - 20) * VOXEL] * 3, indexing="ij"), -1)
        # Not round, so that its ways differ where the background is the same.
        distance = np.linalg.norm(nodes * [1, 1, 1.4 + time], axis=-1) - RADIUS
        return SignedDistance.of(distance[None] / VOXEL, np.full(3, -20 * VOXEL), VOXEL)

    def empty_view(self, camera: Camera) -> np.ndarray:
        u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
        scale = 60 / camera.width
        waves = [0.5 + 0.3 * np.sin(scale * (a * u + b * v)) for a, b in ((0.9, 0.3), (0.4, 0.8), (0.7, -0.6))]
        return np.stack(waves, -1).astype(np.float32)

    def render(self, camera: Camera, time: float) -> Render:
        interface = smoothed(cast(self.surface(time), camera), camera)
        behind = to_linear(self.empty_view(camera))
        through = seen_through(behind, interface, camera, self.index)
        mirrored = reflectance(facing(interface, camera))[..., None]
        passed = transmittance(interface.length, self.dye.absorption)
        light = (1 - mirrored) * (through * passed + self.dye.albedo * (1 - passed)) + mirrored * ROOM
        light += self.gloss * (interface.normal[..., 1:2] > 0.97)
        alpha = interface.seen.astype(np.float32)
        return Render(to_srgb(np.where(interface.seen[..., None], light, behind)), alpha)

    def particles(self) -> None:
        return None

    def save(self, directory: Path) -> None:
        raise NotImplementedError


def cameras() -> dict[str, Camera]:
    K = np.array([[260.0, 0, 60], [0, 260, 45], [0, 0, 1]])
    places = [(0.5 * np.sin(a), 0.15, 0.5 * np.cos(a)) for a in (-0.5, -0.2, 0.1, 0.4)]
    return {str(k): Camera(str(k), 120, 90, K, look_at(place)) for k, place in enumerate(places)}


def of(fitted: Fitted, metres_per_unit: float | None = 1.0) -> Reconstruction:
    """`fitted` as if it had been loaded."""
    all_of = cameras()
    times = np.array([0.0, 0.1, 0.2])
    test = {"3": all_of.pop("3")}
    known = SimpleNamespace(
        train=tuple(all_of), test=tuple(test), cameras=all_of, test_cameras=test, times=times, gravity=None,
        metres_per_unit=metres_per_unit, times_source="scene.json", camera_times=dict.fromkeys([*all_of, *test], times),
    )  # fmt: skip
    submission = SimpleNamespace(
        identity=SimpleNamespace(method="ball", preset="best", scene="wall"),
        directory=Path("submissions/ball"),
        digest="0" * 64,
        particles=lambda: None,
        geometry=lambda: None,
    )
    return Reconstruction(submission, fitted, known, None)  # type: ignore[arg-type]


@pytest.fixture
def blue() -> Dye:
    """Per scene unit, which is a metre."""
    return Dye(np.array([0.03, 0.12, 0.45], np.float32), np.array([60.0, 25.0, 6.0], np.float32))
