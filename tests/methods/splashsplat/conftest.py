"""Shared by SplashSplat's tests: torch on one thread, since the tensors are small."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from splashbench.gaussians.torch_threads import one_torch_thread
from splashbench.scene import TrainingScene
from splashbench_methods import scaffold_gs
from splashbench_methods.scaffold_gs import BackgroundSettings


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
