"""What the fit of the appearance begins with: carriers that coarse grids taught to be transparent are not there."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from splashbench.harness.contract import Run
from splashbench.observe.grid import Grid
from splashbench.scene import Scene
from splashbench_methods.splashsplat import SplashSplat, SplashSplatConfig, beginning, reconstruction
from splashbench_methods.splashsplat.appearance.decoder import DecoderSettings
from splashbench_methods.splashsplat.appearance.fit_settings import FitSettings
from splashbench_methods.splashsplat.appearance.fitting import Fit, initial_appearance, visible_carriers
from splashbench_methods.splashsplat.appearance.targets import TrainingTarget
from splashbench_methods.splashsplat.carriers.population import Carriers, undeformed
from splashbench_methods.splashsplat.carriers.subframe import Track
from splashbench_methods.splashsplat.fields.sparse_frames import SparseFrames
from splashbench_methods.splashsplat.motion.steps import Motion
from splashbench_methods.splashsplat.trace import Traced

SMALL = {"hull_cells": 32, "transport_cells": 16, "control_cells": 6, "velocity_steps": 2, "self_calibration": False}


def _traced() -> Traced:
    """Carriers 0 to 2 in the first frame, 1 to 4 in the second."""
    ids = np.array([0, 1, 2, 1, 2, 3, 4], dtype=np.int32)
    positions = np.arange(21, dtype=np.float32).reshape(7, 3) / 8
    phi = np.arange(7, dtype=np.float32)
    carriers = Carriers(np.array([0, 3, 7]), ids, positions, undeformed(7), phi, 5)
    frames = SparseFrames((4, 4, 4), [np.zeros((4, 4, 4), np.int8)] * 2)
    motion = Motion(np.zeros((1, 4, 4, 4, 3), np.float32), 2, [None])
    observed: Any = None
    config: Any = None
    return Traced(observed, Track(Grid(np.zeros(3), 1.0, (4, 4, 4)), carriers, motion, frames), config)


def _target(frame: int, hidden: list[int] | None, in_front: list[bool] | None) -> TrainingTarget:
    photograph: Any = None
    camera: Any = None
    return TrainingTarget(
        frame=frame,
        fraction=0.0,
        camera=camera,
        eye=torch.zeros(3),
        photograph=photograph,
        background=torch.zeros(3),
        area=1.0,
        hidden=None if hidden is None else torch.tensor(hidden, dtype=torch.uint8),
        in_front=None if in_front is None else torch.tensor(in_front),
    )


def test_carriers_that_are_left_out_are_nowhere_any_more() -> None:
    traced = _traced()
    before = traced.track
    decoder = DecoderSettings(feature_size=8, children=1, color_width=8)
    appearance = initial_appearance(5, 1.0, FitSettings(), decoder, 0)
    features = appearance.features.clone()
    first, second = _target(0, [10, 20, 30], None), _target(1, None, [True, True, False, False])
    first.coarse = replace(first)
    beginning._leave_out(np.array([True, False, True, False, True]), traced, appearance, [first, second])
    assert traced.track.carriers.count == 3
    assert traced.track.carriers.ids.tolist() == [0, 1, 1, 2]
    np.testing.assert_array_equal(traced.track.carriers.positions, before.carriers.positions[[0, 2, 4, 6]])
    assert torch.equal(appearance.features, features[[0, 2, 4]])
    assert len(appearance.log_scales) == 3
    assert first.hidden is not None
    assert first.hidden.tolist() == [10, 30]
    assert first.coarse is not None
    assert first.coarse.hidden is not None
    assert first.coarse.hidden.tolist() == [10, 30]
    assert second.in_front is not None
    assert second.in_front.tolist() == [True, False]


@pytest.mark.parametrize("share", [0.0, 0.4])
def test_the_fit_begins_with_what_coarse_grids_left(
    share: float, balls: Scene, flat_background: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    kept: list[np.ndarray] = []
    begun: list[tuple[int, bool]] = []
    keep, fit = Traced.keep, reconstruction.fit_appearance

    def note_kept(self: Traced, chosen: np.ndarray) -> np.ndarray:
        kept.append(chosen)
        return keep(self, chosen)

    def note_begun(look: Any, track: Track, *others: Any) -> Fit:
        begun.append((track.carriers.count, bool(visible_carriers(look, 0.05).all())))
        return fit(look, track, *others)

    monkeypatch.setattr(Traced, "keep", note_kept)
    monkeypatch.setattr(reconstruction, "fit_appearance", note_begun)
    settings = SMALL | {"background_preset": "quick", "iterations": 300, "prune_opacity": 0.05}
    config = SplashSplatConfig.preset("best", settings | {"coarse_grids_share": share})
    SplashSplat().fit(balls.training(), config, Run())
    if share == 0:
        assert kept == []
        return
    (chosen,) = kept
    assert 0 < chosen.sum() < len(chosen)
    assert begun[-1] == (chosen.sum(), True)
