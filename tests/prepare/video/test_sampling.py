"""Timesteps are spread over real time; every camera's own true frame times are kept."""

from __future__ import annotations

import numpy as np
import pytest

from splashbench.errors import SplashbenchError
from splashbench.prepare.audio.sync import ClockFit
from splashbench.prepare.video.sampling import sample_frames, sample_times


def clock(start: float = 0.0, rate: float = 1.0) -> ClockFit:
    return ClockFit(start, rate, 10.0, 1e-5, 10, "ok")


def test_sixty_frames_a_second_into_fifty_timesteps_alternates() -> None:
    """Table S1, bowl_001: 5.34 s in 50 timesteps, 109.0 ms apart on the mean: 6.54 source frames."""
    frame_times = {"1": np.arange(600) / 60}
    sampling = sample_frames(sample_times((1.0, 6.34)), frame_times, {"1": clock()})
    steps = np.diff(sampling.indices["1"])
    assert set(steps.tolist()) == {6, 7}
    assert np.mean(np.diff(sampling.times)) == pytest.approx(0.109, abs=2e-4)
    np.testing.assert_array_equal(sampling.camera_times["1"], frame_times["1"][sampling.indices["1"]])
    assert np.abs(sampling.camera_times["1"] - sampling.nominal).max() <= 0.5 / 60 + 1e-12
    assert not sampling.flagged["1"].any()


def test_offset_and_rate_of_a_clock_are_respected() -> None:
    frame_times = {"1": np.arange(600) / 60, "2": np.arange(620) / 59.94}
    clocks = {"1": clock(), "2": clock(-0.4123, 1 - 81e-6)}
    sampling = sample_frames(sample_times((2.0, 5.0)), frame_times, clocks)
    true_times = -0.4123 + (1 - 81e-6) * np.arange(620) / 59.94
    brute = np.array([np.argmin(np.abs(true_times - t)) for t in sampling.nominal])
    np.testing.assert_array_equal(sampling.indices["2"], brute)
    np.testing.assert_allclose(sampling.camera_times["2"], true_times[brute], atol=1e-12)
    np.testing.assert_allclose(
        sampling.times, (sampling.camera_times["1"] + sampling.camera_times["2"]) / 2, atol=1e-12
    )
    np.testing.assert_allclose(
        sampling.spread_s, np.abs(sampling.camera_times["1"] - sampling.camera_times["2"]), atol=1e-12
    )
    assert sampling.spread_s.max() <= 1 / 59.94


def test_a_dropped_frame_is_flagged() -> None:
    local = np.delete(np.arange(300) / 30, [120, 121])
    times = sample_times((3.0, 6.0), 31)
    sampling = sample_frames(times, {"1": local}, {"1": clock()})
    missed = np.isin(np.round(times * 30).astype(int), [120, 121])
    np.testing.assert_array_equal(sampling.flagged["1"], missed)
    assert missed.sum() == 1


def test_an_interval_outside_the_recording_is_refused() -> None:
    frame_times = {"1": np.arange(300) / 30, "2": np.arange(300) / 30}
    with pytest.raises(SplashbenchError, match=r"camera 2 recorded 2\.000 to .*narrow motion_interval"):
        sample_frames(sample_times((1.0, 4.0)), frame_times, {"1": clock(), "2": clock(2.0)})


def test_more_timesteps_than_source_frames_are_refused_with_the_number_that_fits() -> None:
    frame_times = {"1": np.arange(300) / 30}
    times = sample_times((1.0, 2.0), 50)
    with pytest.raises(SplashbenchError, match=r"camera 1: 50 timesteps .* to 31 or fewer"):
        sample_frames(times, frame_times, {"1": clock()})
    assert len(sample_frames(sample_times((1.0, 2.0), 31), frame_times, {"1": clock()}).times) == 31


@pytest.mark.parametrize(("interval", "timesteps"), [((2.0, 2.0), 50), ((3.0, 2.0), 50), ((1.0, 2.0), 1)])
def test_nonsense_is_a_programming_error(interval: tuple[float, float], timesteps: int) -> None:
    with pytest.raises(ValueError, match="sampling needs"):
        sample_times(interval, timesteps)
