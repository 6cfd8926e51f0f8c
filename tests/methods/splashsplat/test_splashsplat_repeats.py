"""Timesteps that show nothing new are not modelled anew."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from splashbench.harness.contract import Run
from splashbench.observe import Silhouettes
from splashbench.scene import Scene
from splashbench_methods.splashsplat import SplashSplat
from splashbench_methods.splashsplat.fields.repeats import repeated_frames
from splashbench_methods.splashsplat.method import FittedSplashSplat
from splashbench_methods.splashsplat.trace import trace_liquid

TINY = {"hull_cells": 40, "transport_cells": 20, "control_cells": 6, "iterations": 30, "voxel_pixels": 0}


@pytest.fixture
def doubled(balls_copy: Path) -> Path:
    """The scene of balls with every timestep twice."""
    path = balls_copy / "scene.json"
    meta = json.loads(path.read_text())
    times = np.array(meta["times"])
    halfway = np.append((times[:-1] + times[1:]) / 2, times[-1] + np.diff(times)[-1] / 2)
    path.write_text(json.dumps(meta | {"times": np.stack([times, halfway], axis=1).ravel().tolist()}))
    for name in ("train_meta.json", "test_meta.json"):
        path = balls_copy / name
        views = {
            key: [entry for entry in value for _ in (0, 1)] if isinstance(value, list) else value
            for key, value in json.loads(path.read_text()).items()
        }
        # Every second time under another name.
        for number, names in enumerate(views["fn"]):
            if number % 2 == 1:
                views["fn"][number] = [name.replace(".png", "b.png") for name in names]
        path.write_text(json.dumps(views))
    for image in [*balls_copy.glob("ims/*/*.png"), *balls_copy.glob("seg/*/*.png")]:
        shutil.copyfile(image, image.with_stem(f"{image.stem}b"))
    return balls_copy


def fit(directory: Path, **settings: object) -> tuple[FittedSplashSplat, Run]:
    run = Run()
    config = SplashSplat.Config.preset("quick", TINY | settings)
    return SplashSplat().fit(Scene.open(directory).training(), config, run), run


def carriers(directory: Path) -> float:
    """How many carriers there are in all, the mean of four seeds: one differs from the next by two per cent."""
    config = SplashSplat.Config.preset("quick", TINY)
    training = Scene.open(directory).training()
    return float(np.mean([trace_liquid(training, config, Run(seed=seed)).track.carriers.count for seed in range(4)]))


@pytest.mark.slow
def test_a_recording_with_every_frame_twice_buys_nothing(doubled: Path, balls_directory: Path) -> None:
    once, _ = fit(balls_directory)
    twice, run = fit(doubled)
    assert run.notes["repeated frames"].startswith(f"{len(once.liquid.times)} of {len(twice.liquid.times)}")
    assert carriers(doubled) == pytest.approx(carriers(balls_directory), rel=0.02)
    assert twice.liquid.stored_bytes < 1.1 * once.liquid.stored_bytes
    told_apart, _ = fit(doubled, repeats=False)
    assert told_apart.liquid.carriers.count > 1.3 * once.liquid.carriers.count
    # What is repeated stands still.
    for t in range(0, len(twice.liquid.times), 2):
        first, second = (twice.liquid.carriers.rows(frame) for frame in (t, t + 1))
        np.testing.assert_array_equal(twice.liquid.carriers.ids[first], twice.liquid.carriers.ids[second])
        np.testing.assert_array_equal(twice.liquid.carriers.positions[first], twice.liquid.carriers.positions[second])


def test_a_timestep_whose_light_changes_is_no_repetition(doubled: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = Scene.open(doubled).training()
    assert repeated_frames(scene, Silhouettes(scene)).tolist() == [False, True] * (scene.n_frames // 2)
    # The liquid alone, which is a small part of the photograph.
    darker, liquid = np.array(scene.image(scene.train[0], 1)), scene.mask(scene.train[0], 1)
    darker[liquid] -= np.minimum(darker[liquid], 3)
    assert np.abs(darker.astype(int) - scene.image(scene.train[0], 1)).mean() < 0.5
    seen = scene.image
    monkeypatch.setattr(scene, "image", lambda name, t: darker if (name, t) == (scene.train[0], 1) else seen(name, t))
    assert repeated_frames(scene, Silhouettes(scene)).tolist()[:4] == [False, False, False, True]
