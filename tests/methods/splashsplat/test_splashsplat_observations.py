"""Observation fields shared by the runs of a study: the same to the last bit, by what they depend on."""

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from splashbench.harness.contract import Run
from splashbench.observe import Bounds, Silhouettes, sequence_bounds
from splashbench.observe.occlusion import ContainerOcclusion
from splashbench.observe.reduced_masks import ReducedScene
from splashbench.scene import Scene
from splashbench_methods.splashsplat.fields import observations
from splashbench_methods.splashsplat.fields.observations import Observations, Report, observe
from splashbench_methods.splashsplat.motion.observed_frames import ObservedFrame, observed_frames
from splashbench_methods.splashsplat.settings import SplashSplatConfig

SMALL = {"hull_cells": 32, "transport_cells": 16, "control_cells": 8, "velocity_steps": 3}


def _observed(
    scene: Scene, run: Run, report: Report = lambda done, what: None, **settings: object
) -> tuple[Observations, list[ObservedFrame]]:
    config = SplashSplatConfig.model_validate({**SMALL, **settings})
    training = scene.training()
    observed = observe(training, config.fields, run, report)
    return observed, list(observed_frames(observed, training, config.motion, run, report))


def _assert_same(frames: list[ObservedFrame], others: list[ObservedFrame]) -> None:
    for frame, other in zip(frames, others, strict=True):
        np.testing.assert_array_equal(frame.phi, other.phi)
        np.testing.assert_array_equal(frame.packed, other.packed)
        assert (frame.step is None) == (other.step is None)
        if frame.step is not None and other.step is not None:
            np.testing.assert_array_equal(frame.step.control, other.step.control)


def test_shared_or_not_the_fields_are_the_same_bits(balls: Scene, tmp_path: Path) -> None:
    by_itself, alone = _observed(balls, Run())
    runs = [Run(cache=tmp_path), Run(cache=tmp_path, seed=1)]
    for run in runs:
        observed, frames = _observed(balls, run)
        _assert_same(frames, alone)
        np.testing.assert_array_equal(observed.hull_grid.origin, by_itself.hull_grid.origin)
    assert len(alone) == balls.n_frames
    assert alone[0].step is None
    assert all(frame.step is not None and frame.step.control.any() for frame in alone[1:])
    first, second = runs
    assert first.reused == {}
    assert list(second.reused) == ["bounds", "distances", "velocities"]
    assert "velocity" in first.stages
    assert "velocity" not in second.stages
    assert "failed masks" not in second.stages


@pytest.fixture(scope="module")
def stored(balls: Scene, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What a run with the settings of `SMALL` stores."""
    folder = tmp_path_factory.mktemp("stored")
    _observed(balls, Run(cache=folder))
    return folder


@pytest.mark.parametrize(
    ("settings", "taken_over"),
    [
        ({"lifetime": 5, "iterations": 7}, ["bounds", "distances", "velocities"]),
        ({"gate_motion": False}, ["bounds", "distances"]),
        ({"velocity_smoothing": 1.0}, ["bounds", "distances"]),
        ({"transport_cells": 20}, ["bounds", "distances"]),
        ({"variant": "per_frame"}, ["bounds", "distances"]),
        ({"hull_cells": 36}, []),
        ({"signed_distance": "carve"}, []),
        ({"detect_failed_masks": False}, []),
        ({"replace_empty_masks": False}, []),
        ({"container": False}, []),
        ({"camera_times": False}, []),
        ({"pool": False}, []),
        ({"ballistic": False}, []),
    ],
)
def test_another_run_takes_over_what_its_settings_leave_as_it_was(
    balls: Scene, stored: Path, tmp_path: Path, settings: dict[str, object], taken_over: list[str]
) -> None:
    run = Run(cache=shutil.copytree(stored, tmp_path / "cache"))
    _, shared = _observed(balls, run, **settings)
    assert list(run.reused) == taken_over
    _, alone = _observed(balls, Run(), **settings)
    _assert_same(shared, alone)


def test_masks_that_failed_stay_distrusted(balls: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    distrusted = np.zeros((balls.n_frames, len(balls.train)), dtype=bool)
    distrusted[[1, 4], [0, 2]] = True

    def look(masks: Silhouettes, container: object) -> Bounds:
        masks.distrust(distrusted)
        return sequence_bounds(masks)

    monkeypatch.setattr(observations, "trusted_bounds", look)
    first, _ = _observed(balls, Run(cache=tmp_path))
    monkeypatch.undo()
    run = Run(cache=tmp_path)
    second, _ = _observed(balls, run)
    assert list(run.reused) == ["bounds", "distances", "velocities"]
    np.testing.assert_array_equal(first.silhouettes.failed_masks, distrusted)
    np.testing.assert_array_equal(second.silhouettes.failed_masks, distrusted)


def test_a_run_that_ends_in_the_middle_leaves_no_file_behind(
    balls: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    there: list[str] = []
    real = observations.signed_distance_frames

    def frames(*arguments: Any) -> Iterator[np.ndarray]:
        yield next(real(*arguments))
        # Were the process killed now, this is what would stay.
        there.extend(path.name for path in tmp_path.iterdir() if path.is_file() and path.suffix != ".lock")
        raise RuntimeError("in the middle")

    monkeypatch.setattr(observations, "signed_distance_frames", frames)
    with pytest.raises(RuntimeError, match="in the middle"):
        _observed(balls, Run(cache=tmp_path), pool=False, ballistic=False)
    assert not there
    assert [path.name[:6] for path in sorted(tmp_path.iterdir()) if path.suffix != ".lock"] == ["bounds"]


def test_progress_never_goes_back(balls: Scene, tmp_path: Path) -> None:
    for run in (Run(cache=tmp_path), Run(cache=tmp_path), Run()):
        progress: list[float] = []
        _observed(balls, run, lambda done, what, progress=progress: progress.append(done))  # type: ignore[misc]
        assert progress == sorted(progress)
        assert progress[-1] == 1


def test_grids_are_no_finer_than_the_photographs(balls: Scene) -> None:
    def grids(**settings: object) -> tuple[int, int, float]:
        config = SplashSplatConfig.model_validate({"hull_cells": 300, "transport_cells": 150, **settings})
        observed = observe(balls.training(), config.fields, Run(), lambda done, what: None)
        sides = [max(grid.shape) - 1 for grid in (observed.hull_grid, observed.grid)]
        middle = observed.hull_grid.to_scene((np.array(observed.hull_grid.shape) - 1) / 2)
        pixels = [
            float(np.linalg.norm(camera.center - middle)) / camera.K[0, 0]
            for camera in (balls.cameras[name] for name in balls.train)
        ]
        return sides[0], sides[1], observed.hull_grid.voxel / float(np.median(pixels))

    assert grids(voxel_pixels=0)[:2] == (300, 150)
    hull, transport, pixels = grids(voxel_pixels=0.2)
    assert hull == 2 * transport < 300
    assert pixels == pytest.approx(0.2, rel=0.05)
    # There are some cells however small the photographs, and no more than asked for.
    assert grids(voxel_pixels=16)[:2] == (128, 64)
    assert grids(voxel_pixels=16, hull_cells=64, transport_cells=32)[:2] == (64, 32)


def _looked_at(balls: Scene, monkeypatch: pytest.MonkeyPatch, cells: int) -> tuple[Observations, Silhouettes]:
    """What is observed where coarse grids have `cells`, and the masks in which failed ones are looked for."""
    looked: list[Silhouettes] = []
    real = observations.trusted_bounds

    def look(masks: Silhouettes, container: ContainerOcclusion | None) -> Bounds:
        looked.append(masks)
        masks.distrust(np.arange(balls.n_frames)[:, None] == [[2, 5, 99, 99, 99]])
        return real(masks, container)

    monkeypatch.setattr(observations, "trusted_bounds", look)
    monkeypatch.setattr(observations, "REFINED_CELLS", cells)
    observed, _ = _observed(balls, Run())
    return observed, looked[0]


def test_coarse_grids_take_smaller_masks_of_large_photographs(balls: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    whole, masks = _looked_at(balls, monkeypatch, 96)
    assert masks is whole.silhouettes
    observed, masks = _looked_at(balls, monkeypatch, 4)
    wide = balls.cameras[balls.train[0]].width
    assert masks.cameras[0].width < 0.7 * wide
    assert observed.silhouettes.cameras[0].width == wide
    # What failed in either does in both.
    np.testing.assert_array_equal(observed.silhouettes.failed_masks, masks.failed_masks)
    assert masks.failed_masks[[2, 5], [0, 1]].all()
    # A coarse pixel is two fine ones wide.
    assert observed.pixel is not None
    np.testing.assert_allclose(observed.hull_grid.origin, whole.hull_grid.origin, atol=4 * observed.pixel)
    np.testing.assert_allclose(observed.hull_grid.voxel, whole.hull_grid.voxel, rtol=0.05)


def test_masks_that_would_lose_liquid_stay_as_they_are(balls: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    class Lossy(ReducedScene):
        def mask(self, camera: str, t: int) -> np.ndarray:
            return super().mask(camera, t) & (t != 3)

    monkeypatch.setattr(observations, "ReducedScene", Lossy)
    observed, masks = _looked_at(balls, monkeypatch, 4)
    assert masks is observed.silhouettes
