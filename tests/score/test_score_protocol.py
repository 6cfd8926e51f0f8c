"""A whole submission scored: the oracle is perfect, failures stay failures, ground truth comes from the scene alone."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from splashbench.errors import SplashbenchError
from splashbench.files import write_png
from splashbench.harness.oracle import write_oracle
from splashbench.observe.consistency import inside_mask
from splashbench.scene import Particles, Scene
from splashbench.score import METRICS, PROTOCOL_V1, Protocol, Result, score_submission, shared_fields
from splashbench.score.mixed import liquid_of_mixed
from splashbench.score.protocol import MIN_TIMED_FRAMES, _costs
from splashbench.submission import Record
from splashbench.synth.balls import ball_centers

NAMES = [
    *("psnr", "dpsnr_bg", "ssim", "ssim_fg", "lpips", "spill", "spill_rgb", "jitter_error"),
    *("sigma_d", "mu_d", "uniformity", "delta_e", "miou", "fit_seconds", "render_fps"),
    *("peak_memory_bytes", "peak_device_memory_bytes", "storage_bytes", "dynamic_bytes"),
    *("primitives_per_frame", "particles_per_frame"),
    *("surface_chamfer", "sdf_iou", "sdf_recall", "sdf_precision"),
    *("velocity_epe", "velocity_epe_relative", "airborne_epe_relative", "velocity_coverage"),
]


def test_the_oracle_is_perfect(balls: Scene, tmp_path: Path, quiet: Any) -> None:
    result = score_submission(balls, write_oracle(balls, tmp_path / "oracle"), track=quiet)
    expected = {
        "psnr": 100.0,
        "ssim": 1.0,
        "ssim_fg": 1.0,
        "jitter_error": 0.0,
        "miou": 1.0,
        "spill": 0.0,
        "delta_e": 0.0,
    }
    assert {name: result.value(name) for name in expected} == expected
    assert result.control


def test_a_result_with_figures_under_their_old_names_is_still_read(
    balls: Scene, fake: Any, tmp_path: Path, quiet: Any
) -> None:
    result = score_submission(balls, fake(balls), track=quiet)
    path = result.save(tmp_path)
    path.write_text(path.read_text().replace('"particles_per_frame"', '"carriers_per_frame"'))
    assert '"carriers_per_frame"' in path.read_text()
    assert Result.load(path) == result


def test_the_oracle_has_no_perceptual_distance(balls: Scene, fake: Any, quiet: Any, test_data: Path) -> None:
    weights = test_data / "weights" / "lpips_alex_v0.1.npz"
    perfect = score_submission(balls, fake(balls), lpips_weights=weights, track=quiet)
    assert perfect.value("lpips") == 0.0
    assert perfect.digests.lpips_weights
    darker = fake(balls, change=lambda rgb, alpha, t: (rgb // 2, alpha))
    assert score_submission(balls, darker, lpips_weights=weights, track=quiet).metrics["lpips"].value > 0.001


def test_every_name_of_the_schema_is_there_and_every_null_has_a_reason(balls: Scene, fake: Any, quiet: Any) -> None:
    result = score_submission(balls, fake(balls), track=quiet)
    assert list(result.metrics) == list(METRICS) == NAMES
    for name, metric in result.metrics.items():
        assert (metric.value is None) == bool(metric.reason), name
        assert metric.better == METRICS[name].better
    assert result.metrics["sigma_d"].reason == "the submission has no particles"
    assert result.value("fit_seconds") == 12.5
    assert result.metrics["render_fps"].reason == "not measured"


def test_what_lies_outside_the_mask_does_not_move_the_masked_metrics(balls: Scene, fake: Any, quiet: Any) -> None:
    def haze(rgb: np.ndarray, alpha: np.ndarray, t: int) -> tuple[np.ndarray, np.ndarray]:
        return np.where(alpha[..., None] > 0, rgb, 255).astype(np.uint8), np.where(alpha > 0, alpha, 0.2)

    result = score_submission(balls, fake(balls, change=haze), track=quiet)
    assert (result.value("psnr"), result.value("ssim"), result.value("miou")) == (100.0, 1.0, 1.0)
    # Spill is where it shows: 0.2 over the pixels outside, in units of the mask.
    masks = [balls.mask("6", t) for t in range(balls.n_frames)]
    expected = np.mean([0.2 * np.mean(~mask) / np.mean(mask) for mask in masks])
    assert result.metrics["spill"].views["6"].value == pytest.approx(expected)


def test_means_run_over_frames_then_views(balls: Scene, fake: Any, quiet: Any) -> None:
    def worsening(rgb: np.ndarray, alpha: np.ndarray, t: int) -> tuple[np.ndarray, np.ndarray]:
        return (rgb.astype(int) + np.where(rgb < 128, t, -t)).astype(np.uint8), alpha

    metric = score_submission(balls, fake(balls, change=worsening), track=quiet).metrics["psnr"]
    for view in metric.views.values():
        assert view.frames == pytest.approx([100.0, *(-20 * np.log10(t / 255) for t in range(1, balls.n_frames))])
        assert view.value == pytest.approx(np.mean(view.frames))
    assert metric.value == pytest.approx(np.mean([view.value for view in metric.views.values()]))
    assert set(metric.views) == set(balls.test)


def test_frames_with_too_little_liquid_are_skipped_and_counted(balls_copy: Path, fake: Any, quiet: Any) -> None:
    nearly = np.zeros((64, 96), np.uint8)
    nearly[10:17, 10:19] = 255
    write_png(balls_copy / "seg" / "6" / "000002.png", nearly)
    enough = nearly.copy()
    enough[17, 10] = 255
    write_png(balls_copy / "seg" / "6" / "000003.png", enough)
    scene = Scene.open(balls_copy)
    result = score_submission(scene, fake(scene), track=quiet)
    for name in ("psnr", "ssim", "ssim_fg", "spill"):
        metric = result.metrics[name]
        assert metric.skipped_frames == 1
        assert [t for t, value in enumerate(metric.views["6"].frames) if value is None] == [2]
    assert result.metrics["miou"].skipped_frames == 0


def test_the_reference_gives_the_gain_over_the_background(balls: Scene, fake: Any, quiet: Any) -> None:
    nothing = fake(balls, method="nothing", control=True, seed=9, change=lambda rgb, alpha, t: (0 * rgb, 0 * alpha))
    result = score_submission(balls, fake(balls), nothing, track=quiet)
    itself = score_submission(balls, nothing, nothing, track=quiet)
    assert itself.value("dpsnr_bg") == 0.0
    assert itself.value("spill_rgb") == 0.0
    assert result.value("dpsnr_bg") == pytest.approx(100.0 - itself.metrics["psnr"].value)
    assert result.metrics["spill_rgb"].value > 0
    assert result.digests.reference == nothing.digest
    without = score_submission(balls, fake(balls), track=quiet)
    assert "--reference" in str(without.metrics["dpsnr_bg"].reason)


def test_only_the_control_nothing_is_a_reference(balls: Scene, fake: Any, quiet: Any) -> None:
    with pytest.raises(SplashbenchError, match="give one of the control nothing"):
        score_submission(balls, fake(balls), fake(balls), track=quiet)
    failed = fake(balls, method="nothing", control=True, status="crashed")
    with pytest.raises(SplashbenchError, match="crashed"):
        score_submission(balls, fake(balls), failed, track=quiet)


def test_a_failed_run_is_a_result_and_never_a_score(balls: Scene, fake: Any, quiet: Any, tmp_path: Path) -> None:
    failed = fake(balls, status="out_of_memory", reason="killed (signal 9)", seed=3)
    result = score_submission(balls, failed, track=quiet)
    assert (result.status, result.reason) == ("out_of_memory", "killed (signal 9)")
    assert all(metric.value is None for metric in result.metrics.values())
    assert result.metrics["psnr"].reason == "the run ended with status out_of_memory"
    assert Result.load(result.save(tmp_path)) == result


def test_a_submission_of_another_scene_is_refused(balls: Scene, fake: Any, quiet: Any) -> None:
    with pytest.raises(SplashbenchError, match="another version of scene"):
        score_submission(balls, fake(balls, scene_digest="0" * 64), track=quiet)


def test_wrong_sizes_and_opacities_are_refused(balls: Scene, fake: Any, quiet: Any) -> None:
    smaller = fake(balls, change=lambda rgb, alpha, t: (rgb[::2, ::2], alpha))
    with pytest.raises(SplashbenchError, match="32x48x3, not 64x96x3"):
        score_submission(balls, smaller, track=quiet)
    louder = fake(balls, change=lambda rgb, alpha, t: (rgb, alpha * np.nan))
    with pytest.raises(SplashbenchError, match=r"leaves \[0, 1\]"):
        score_submission(balls, louder, track=quiet)


def test_scoring_twice_gives_the_same_bytes_whatever_the_order_of_particles(
    balls: Scene, fake: Any, quiet: Any, tmp_path: Path
) -> None:
    truth = balls.truth_particles()
    assert truth is not None
    order = np.random.default_rng(0).permutation(truth.positions.shape[1])
    shuffled = Particles(truth.positions[:, order], truth.active[:, order])
    fields = shared_fields(balls)
    files = []
    for name, particles in (("a", truth), ("b", truth), ("c", shuffled)):
        result = score_submission(balls, fake(balls, particle_set=particles), track=quiet, fields=fields)
        files.append(result.save(tmp_path / name).read_bytes())
    assert files[0] == files[1]
    as_numbers = [Result.model_validate_json(data) for data in files]
    for metric in ("sigma_d", "mu_d", "uniformity"):
        assert as_numbers[0].metrics[metric] == as_numbers[2].metrics[metric]
    assert as_numbers[0].metrics["uniformity"].value is not None


def test_particles_of_a_mixed_method_count_inside_all_silhouettes_only(balls: Scene, fake: Any, quiet: Any) -> None:
    truth = balls.truth_particles()
    assert truth is not None
    background = np.random.default_rng(0).uniform(-2, 2, (balls.n_frames, 400, 3))
    positions = np.concatenate([truth.positions, background], axis=1)
    both = Particles(positions, np.ones(positions.shape[:2], bool))
    clean, mixed, dirty = (
        score_submission(balls, fake(balls, particle_set=particles, mixed=flag), track=quiet).metrics["mu_d"].value
        for particles, flag in ((truth, False), (both, True), (both, False))
    )
    assert mixed == pytest.approx(clean, rel=0.05)
    assert dirty < 0.8 * clean


def test_liquid_seen_by_some_training_views_only_is_left_out(balls: Scene) -> None:
    """Points on the rays from one camera through a ball fall into that camera's silhouette, but not into all."""
    centre = ball_centers(float(balls.times[0]))[0]
    eye = balls.cameras[balls.train[0]].center
    on_the_ray = eye + np.linspace(0.5, 1.5, 11)[:, None] * (centre - eye)
    positions = np.repeat(on_the_ray[None], balls.n_frames, axis=0)
    kept = liquid_of_mixed(Particles(positions, np.ones(positions.shape[:2], bool)), balls).active[0]
    assert inside_mask(on_the_ray, balls.cameras[balls.train[0]], balls.mask(balls.train[0], 0)).all()
    assert kept.tolist() == [i == 5 for i in range(11)]


def test_unknown_gravity_scale_or_times_leave_the_energy_unknown(balls_copy: Path, fake: Any, quiet: Any) -> None:
    import json

    path = balls_copy / "scene.json"
    meta = json.loads(path.read_text())
    path.write_text(json.dumps(meta | {"gravity": None, "metres_per_unit": None, "times": None}))
    scene = Scene.open(balls_copy)
    result = score_submission(scene, fake(scene, particle_set=scene.truth_particles()), track=quiet)
    reason = str(result.metrics["delta_e"].reason)
    assert all(word in reason for word in ("gravity", "metric scale", "times"))
    assert result.metrics["sigma_d"].value is not None


def test_particles_with_other_instants_are_not_scored(balls: Scene, fake: Any, quiet: Any) -> None:
    truth = balls.truth_particles()
    assert truth is not None
    short = Particles(truth.positions[:-1], truth.active[:-1])
    result = score_submission(balls, fake(balls, particle_set=short), track=quiet)
    assert "instants" in str(result.metrics["uniformity"].reason)


def test_protocol_v1_is_what_earlier_results_were_scored_by() -> None:
    """Results of another digest would no longer count as the same protocol, and a submission scored twice as two."""
    assert PROTOCOL_V1.digest == "a4545659af50851b5fe66b3969e2fe73dc8ef67f082a847e5e6047b6415c785f"


def test_a_changed_setting_is_no_longer_protocol_v1(balls: Scene, fake: Any, quiet: Any) -> None:
    changed = Protocol(outside_mask="truth")
    assert PROTOCOL_V1.label == "v1"
    assert changed.label.startswith("v1+")
    first, second = (score_submission(balls, fake(balls), track=quiet, protocol=p) for p in (PROTOCOL_V1, changed))
    assert first.digests.protocol != second.digests.protocol
    assert first.file_name != second.file_name


def test_results_and_protocols_cannot_be_changed_in_place(balls: Scene, fake: Any, quiet: Any) -> None:
    result = score_submission(balls, fake(balls), track=quiet)
    with pytest.raises(ValueError, match="frozen"):
        result.status = "better"  # type: ignore[misc]
    with pytest.raises(ValueError, match="frozen"):
        result.metrics["psnr"].value = 200.0  # type: ignore[misc]


def test_ground_truth_is_never_read_from_the_submission(balls: Scene, tmp_path: Path, quiet: Any) -> None:
    """Renders and "ground truth" folders of a submission's own making change nothing but the renders' score."""
    from splashbench.submission import Submission, seal

    oracle = write_oracle(balls, tmp_path / "oracle")
    for t in range(balls.n_frames):
        for name in balls.test:
            grey = np.full((64, 96, 3), 128, np.uint8)
            write_png(oracle.directory / "renders" / name / f"{t:06d}.png", grey)
            for folder in ("ims", "gt", "truth"):
                write_png(oracle.directory / folder / name / f"{t:06d}.png", grey)
    seal(oracle.directory, oracle.identity, oracle.record)
    result = score_submission(balls, Submission.open(oracle.directory), track=quiet)
    assert result.metrics["psnr"].value < 20


@pytest.mark.parametrize(("timed", "fps"), [(MIN_TIMED_FRAMES - 1, None), (MIN_TIMED_FRAMES, 30.0), (None, 30.0)])
def test_a_frame_rate_needs_a_hundred_timed_frames(timed: int | None, fps: float | None) -> None:
    value = _costs(Record(fit_seconds=60.0, render_fps=30.0, timed_frames=timed))["render_fps"]
    assert value.value == fps
    assert value.reason == (None if fps else "only 99 frames were timed, not 100")
