"""The facts of the real scenes and the paper's figures: what a user reads from them agrees with what the paper says."""

from __future__ import annotations

import statistics
from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError

from splashbench.manifest import (
    Archive,
    SceneFacts,
    load_archive,
    load_comparison,
    load_evaluation,
    load_scenes,
    load_targets,
)
from splashbench.paper_figures import paper_one_step_rows, paper_rows

ROOT = Path(__file__).parents[1]


def paper_figure(method: str, scene_set: str, metric: str) -> float:
    (figure,) = [row[metric] for row in paper_rows() if (row["method"], row["scene_set"]) == (method, scene_set)]
    assert isinstance(figure, float)
    return figure


def test_there_are_seventeen_bowls_and_three_tanks_in_order() -> None:
    scenes = load_scenes()
    expected = [f"bowl_{i:03d}" for i in range(1, 18)] + [f"tank_{i:03d}" for i in range(1, 4)]
    assert list(scenes) == expected
    assert all(name.startswith(scene.container) for name, scene in scenes.items())


def test_the_synchronisation_figures_are_those_the_paper_sums_up() -> None:
    """Supplement: median 5.2 ms, 17 of 20 under half a frame, the others flagged; half of the scenes 7.5, half 4.1."""
    scenes = load_scenes().values()
    assert statistics.median(scene.sync_rms_ms for scene in scenes) == pytest.approx(5.2, abs=0.051)
    over_half_a_frame = {scene.name for scene in scenes if scene.sync_rms_ms > 1000 / 120}
    assert over_half_a_frame == {"bowl_008", "bowl_014", "bowl_015"}
    assert over_half_a_frame == {scene.name for scene in scenes if scene.camera_a_frame_off}
    assert sum(scene.fewer_than_seven_measured for scene in scenes) == 10
    assert statistics.mean(scene.sync_rms_ms for scene in scenes) == pytest.approx((7.5 + 4.1) / 2, abs=0.051)


def test_no_session_is_named_that_the_paper_does_not_name() -> None:
    assert {scene.session for scene in load_scenes().values()} == {None}


@pytest.mark.parametrize("name", list(load_scenes()))
def test_times_span_the_interval_with_the_mean_step(name: str) -> None:
    scene = load_scenes()[name]
    times = scene.times()
    assert times.shape == (50,)
    assert times.dtype == np.float64
    assert times[0] == 0.0
    np.testing.assert_allclose(np.diff(times), scene.mean_step_ms / 1000, rtol=1e-9)
    # Both columns are rounded: the interval to 5 ms, the step to 0.05 ms over 49 steps.
    assert times[-1] == pytest.approx(scene.interval_s, abs=0.005 + 49 * 0.00005)


def test_times_of_a_shortened_scene_keep_the_step() -> None:
    scene = load_scenes()["bowl_003"]
    np.testing.assert_allclose(scene.times(3), [0.0, 0.080, 0.160], atol=1e-12)
    assert scene.times(0).shape == (0,)
    with pytest.raises(ValueError, match="cannot be negative"):
        scene.times(-1)


def test_facts_cannot_be_changed_or_extended() -> None:
    scene = load_scenes()["tank_001"]
    with pytest.raises(ValidationError):
        scene.interval_s = 1.0  # type: ignore[misc]
    with pytest.raises(ValidationError):
        SceneFacts.model_validate({**scene.model_dump(), "colour": "blue"})


def test_the_split_is_five_against_two() -> None:
    evaluation = load_evaluation()
    assert evaluation.train_cameras == ("1", "2", "3", "4", "5")
    assert evaluation.test_cameras == ("6", "7")
    # 20 scenes, seven cameras: the 7 000 images of Section 3.
    n_cameras = len(evaluation.train_cameras) + len(evaluation.test_cameras)
    assert len(load_scenes()) * n_cameras * evaluation.n_frames == 7000


def test_the_archive_awaits_its_checksum_and_would_refuse_a_false_one() -> None:
    archive = load_archive()
    assert archive.license == "CC-BY-4.0"
    assert archive.drive_file_id in archive.url
    assert archive.sha256 is None
    assert archive.bytes is None
    assert archive.checksum_note
    filled = archive.model_dump()
    assert Archive.model_validate({**filled, "sha256": "0" * 64, "bytes": 1}).sha256 == "0" * 64
    with pytest.raises(ValidationError):
        Archive.model_validate({**filled, "sha256": "not a digest"})


def test_table_1_has_seven_datasets_beside_this_one() -> None:
    rows = {row.dataset: row for row in load_comparison()}
    assert len(rows) == 8
    ours = rows.pop("SplashSplat")
    evaluation = load_evaluation()
    assert (ours.width, ours.height, ours.fps) == (evaluation.width, evaluation.height, evaluation.source_fps)
    assert ours.scenes == len(load_scenes())
    # The claim of the caption: the only real liquid dataset with more than two synchronised views.
    assert not [r for r in rows.values() if r.medium == "liquid" and r.source == "real" and r.views > 2]
    assert rows["TransProteus"].scenes is None
    assert rows["TransProteus"].images == 50_000


def test_every_target_is_the_papers_figure_and_names_the_best_baseline() -> None:
    baselines = {"deformable_3dgs", "spacetime_gaussians", "scaffold_4d"}
    for target in load_targets():
        assert target.splashsplat == paper_figure("splashsplat", target.scene_set, target.metric)
        measured = {str(row["method"]) for row in paper_rows() if row["scene_set"] == target.scene_set}
        theirs = {method: paper_figure(method, target.scene_set, target.metric) for method in baselines & measured}
        if target.best_baseline_method is None:
            assert not theirs
            continue
        best = (max if target.higher_is_better else min)(theirs, key=lambda method: theirs[method])
        assert (target.best_baseline_method, target.best_baseline) == (best, theirs[best])


def test_the_papers_rows_are_marked_as_reported() -> None:
    rows = paper_rows() + paper_one_step_rows()
    assert {row["hardware"] for row in rows} == {"V100-32GB, as reported"}
    assert all(row["source"] for row in rows)
    keys = [(row["method"], row["scene_set"]) for row in paper_rows()]
    assert len(keys) == len(set(keys))


def test_the_papers_rows_agree_with_its_own_text() -> None:
    full = paper_figure("splashsplat", "ablation_10", "psnr")
    assert (
        full == paper_figure("splashsplat", "views_10", "psnr") == paper_figure("splashsplat", "sensitivity_10", "psnr")
    )
    # Section 5.2: 2.84 dB between the full model and a rendering without liquid.
    assert full - paper_figure("nothing", "ablation_10", "psnr") == pytest.approx(2.84)
    # Section 5.2: the carriers fall from 26.7k to 0.8k without resampling, and rise to 56.4k per frame.
    counts = [
        paper_figure(f"splashsplat{v}", "ablation_10", "carriers") for v in ("", "[without_resampling]", "[per_frame]")
    ]
    assert counts == [26_700, 800, 56_400]
    # Supplement: 95.6 % of carriers stay inside the liquid, 84.0 % with FLIP, 92.8 % where they are.
    assert {row["predictor"]: row["validity"] for row in paper_one_step_rows()[:3]} == {
        "ours": 0.956,
        "no_motion": 0.928,
        "flip": 0.840,
    }


@pytest.mark.parametrize("package", ["data_manifest", "leaderboards"])
def test_the_readme_lists_every_data_file(package: str) -> None:
    readme = (ROOT / package / "README.md").read_text(encoding="utf-8")
    names = [path.name for path in (ROOT / package).iterdir() if path.suffix in {".csv", ".json"}]
    assert names
    assert [name for name in names if name not in readme] == []
