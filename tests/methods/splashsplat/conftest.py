"""Shared by SplashSplat's tests: torch on one thread, since the tensors are small; containers are looked for once."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping

import numpy as np
import pytest
from numpy.typing import ArrayLike

from splashbench.background.clean_plate import CleanPlate
from splashbench.container.footage_vessel import Standing, standing_about_liquid
from splashbench.gaussians.torch_threads import one_torch_thread
from splashbench.scene import TrainingScene
from splashbench_methods import scaffold_gs
from splashbench_methods.scaffold_gs import BackgroundSettings
from splashbench_methods.splashsplat import course
from splashbench_methods.splashsplat.fields import observations

_STANDING: dict[bytes, Standing] = {}


def _standing_once(scene: TrainingScene, plates: Mapping[str, CleanPlate]) -> Standing:
    """`standing_about_liquid`, whose search takes most of a small fit, once for the same footage.

    What it finds is tested in tests/container/test_footage_vessel.py.
    """
    seen: list[ArrayLike | None] = [scene.gravity, scene.initial_points()]
    for name, plate in plates.items():
        camera = scene.cameras[name]
        masks = [scene.mask(name, t) for t in range(scene.n_frames)]
        seen += [camera.K, camera.w2c, *masks, plate.image, plate.seen, plate.beside]
    told = hashlib.sha256(repr(list(plates)).encode())
    for array in (np.asarray(each) for each in seen if each is not None):
        told.update(repr((array.shape, array.dtype)).encode() + array.tobytes())
    key = told.digest()
    if key not in _STANDING:
        _STANDING[key] = standing_about_liquid(scene, plates)
    return _STANDING[key]


@pytest.fixture(autouse=True)
def _containers_looked_for_once(monkeypatch: pytest.MonkeyPatch) -> None:
    for module in (course, observations):
        monkeypatch.setattr(module, "standing_about_liquid", _standing_once)


@pytest.fixture(autouse=True)
def _one_thread() -> Iterator[None]:
    with one_torch_thread():
        yield


@pytest.fixture
def short_background(monkeypatch: pytest.MonkeyPatch) -> None:
    """The background of `quick` takes 20 steps instead of 400."""
    monkeypatch.setitem(BackgroundSettings.presets, "quick", BackgroundSettings.presets["quick"] | {"iterations": 20})


@pytest.fixture
def flat_background(monkeypatch: pytest.MonkeyPatch) -> None:
    """The background is one colour and takes no time."""

    def shared_background(scene: TrainingScene, *_: object, **__: object) -> scaffold_gs.Background:
        return scaffold_gs.flat_background(scaffold_gs.clean_plates(scene))

    monkeypatch.setattr(scaffold_gs, "shared_background", shared_background)
