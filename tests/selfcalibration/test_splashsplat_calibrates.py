"""splashsplat fits a scene as its footage says that it was recorded, and notes so; its preset `paper` as it is told."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from splashbench import toml
from splashbench.harness.contract import Run
from splashbench.scene import Camera, Scene, SceneMeta, TrainingScene, write_scene
from splashbench.selfcalibration import SelfCalibration
from splashbench_methods.splashsplat import SplashSplat, SplashSplatConfig, course  # type: ignore[import-not-found]

from .conftest import NAMES, arc_camera, discs, light, photograph

SMALL = toml.load(Path(__file__).parents[1] / "methods" / "small_fits.toml")["splashsplat"]


class Traced(Exception):
    """Ends a fit where the liquid would be traced; holds the scene that it would be traced in."""


@pytest.fixture(scope="module")
def lit(tmp_path_factory: pytest.TempPathFactory, cameras: dict[str, Camera]) -> Scene:
    """Three timesteps of a ball; camera 2 lets in half a stop more."""
    directory = tmp_path_factory.mktemp("lit") / "lit"
    every = {**cameras, "6": arc_camera("6", 8)}
    frames = []
    for name, camera in every.items():
        for t in range(3):
            mask = discs(camera, np.array([[0.1 * t - 0.2, 0.3, 0]]), np.array([14.0]))
            image = np.where(mask[..., None], np.array([40, 70, 200], np.uint8), photograph(camera))
            frames.append((name, t, light(image, 0.5) if name == "2" else image, mask))
    meta = SceneMeta(name="lit", times=[0, 0.03, 0.06])
    write_scene(directory, cameras=every, train=NAMES, test=("6",), n_frames=3, frames=iter(frames), meta=meta)
    return Scene.open(directory)


def traced(scene: Scene, preset: str, monkeypatch: pytest.MonkeyPatch) -> tuple[TrainingScene, Run]:
    """The scene that the liquid is traced in by `preset`, and what the run noted until then."""

    def trace(seen: TrainingScene, *others: object) -> None:
        raise Traced(seen)

    monkeypatch.setattr(course, "trace_liquid", trace)
    monkeypatch.setattr("splashbench_methods.scaffold_gs.shared_background", lambda *others, **named: None)
    run = Run(seed=1)
    with pytest.raises(Traced) as stopped:
        SplashSplat().fit(scene.training(), SplashSplatConfig.preset(preset, SMALL), run)
    return stopped.value.args[0], run


def test_the_preset_quick_goes_by_it_and_notes_it(lit: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    scene, run = traced(lit, "quick", monkeypatch)
    assert run.notes == {"self-calibration": "camera 2 sees light otherwise than most: +0.50 EV"}
    assert "self-calibration" in run.stages
    assert scene.variation
    assert scene.image("2", 0).mean() == pytest.approx(light(lit.image("2", 0), -0.5).mean(), abs=1)


def test_noise_is_noted_and_changes_nothing(lit: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(course, "self_calibration", lambda *others: SelfCalibration(noisy={"3": 22.4}))
    scene, run = traced(lit, "quick", monkeypatch)
    told = "camera 3: photographs have 22 levels of noise, too much to hold masks against them"
    assert run.notes == {"self-calibration": told}
    assert scene.variation == ""


def test_the_preset_paper_goes_by_what_it_is_told(lit: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    assert SplashSplatConfig().self_calibration
    assert not SplashSplatConfig.preset("paper").self_calibration
    scene, run = traced(lit, "paper", monkeypatch)
    assert "self-calibration" not in {**run.notes, **run.stages}
    assert scene.variation == ""
    np.testing.assert_array_equal(scene.image("2", 0), lit.image("2", 0))
