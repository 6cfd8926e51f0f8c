"""The playing clock shows each timestep for as long as it lasted, at any speed, and keeps to its ends."""

from __future__ import annotations

import pytest

from splashbench.viewer.clock import SPEEDS, PlayClock

TIMES = [0.0, 0.1, 0.3, 0.4]  # the last one is shown for the mean step, .1333 s


class Now:
    """A clock that the test sets."""

    def __init__(self) -> None:
        self.seconds = 100.0

    def __call__(self) -> float:
        return self.seconds


@pytest.fixture
def now() -> Now:
    return Now()


@pytest.fixture
def clock(now: Now) -> PlayClock:
    return PlayClock(TIMES, now)


def seen(clock: PlayClock, now: Now, steps: int, every: float) -> list[int]:
    """The timesteps that are shown, each `every` seconds."""
    found = []
    for _ in range(steps):
        found.append(clock.tick())
        now.seconds += every
    return found


def test_it_stands_until_it_is_played(clock: PlayClock, now: Now) -> None:
    assert seen(clock, now, 3, 1.0) == [0, 0, 0]
    assert clock.until_next() is None


def test_uneven_steps_last_as_long_as_they_did(clock: PlayClock, now: Now) -> None:
    clock.play()
    now.seconds += 0.025
    assert seen(clock, now, 11, 0.05) == [0, 0, 1, 1, 1, 1, 2, 2, 3, 3, 3]


@pytest.mark.parametrize("speed", SPEEDS.values())
def test_at_a_part_of_the_speed_everything_lasts_longer(clock: PlayClock, now: Now, speed: float) -> None:
    clock.speed = speed
    clock.play()
    now.seconds += 0.025 / speed
    assert seen(clock, now, 11, 0.05 / speed) == [0, 0, 1, 1, 1, 1, 2, 2, 3, 3, 3]


def test_the_speeds_are_halves_down_to_a_sixteenth() -> None:
    assert list(SPEEDS.values()) == [1, 0.5, 0.25, 0.125, 0.0625]


def test_another_speed_does_not_jump(clock: PlayClock, now: Now) -> None:
    clock.play()
    now.seconds += 0.2
    clock.speed = 0.25
    assert clock.tick() == 1
    now.seconds += 0.39
    assert clock.tick() == 1
    now.seconds += 0.02
    assert clock.tick() == 2


def test_it_goes_round_and_keeps_time(clock: PlayClock, now: Now) -> None:
    clock.play()
    now.seconds += 5 * (0.4 + 0.4 / 3) + 0.35
    assert clock.tick() == 2
    assert clock.playing


def test_without_a_loop_it_stops_at_the_last_and_starts_anew(clock: PlayClock, now: Now) -> None:
    clock.loop = False
    clock.play()
    now.seconds += 7
    assert clock.tick() == 3
    assert not clock.playing
    clock.play()
    assert clock.tick() == 0


def test_stepping_pauses_and_goes_round_the_ends(clock: PlayClock, now: Now) -> None:
    clock.play()
    now.seconds += 0.15
    clock.step(1)
    assert (clock.tick(), clock.playing) == (2, False)
    clock.step(2)
    assert clock.tick() == 0
    clock.step(-1)
    assert clock.tick() == 3


def test_seeking_plays_on_from_there(clock: PlayClock, now: Now) -> None:
    clock.play()
    clock.seek(2)
    now.seconds += 0.05
    assert clock.tick() == 2
    now.seconds += 0.06
    assert clock.tick() == 3
    clock.seek(99)
    assert clock.tick() == 3
    assert clock.seconds == 0.4


def test_all_of_it_is_of_one_moment(clock: PlayClock, now: Now) -> None:
    clock.play()
    now.seconds += 0.15
    assert clock.read() == (1, 0.1, True)
    clock.loop = False
    now.seconds += 7
    assert clock.read() == (3, 0.4, False)


def test_it_says_how_long_until_the_next(clock: PlayClock, now: Now) -> None:
    clock.speed = 0.5
    clock.play()
    now.seconds += 0.1
    assert clock.until_next() == pytest.approx(0.1)
    now.seconds += 0.15
    assert clock.until_next() == pytest.approx(0.35)


def test_a_picture_alone_does_not_play(now: Now) -> None:
    clock = PlayClock([0.5], now)
    clock.play()
    assert not clock.playing
    clock.step(1)
    assert clock.tick() == 0


@pytest.mark.parametrize("times", [[], [0.0, 0.0], [1.0, 0.5], [0.0, float("nan")]])
def test_times_that_do_not_rise_are_refused(times: list[float]) -> None:
    with pytest.raises(ValueError):
        PlayClock(times)


def test_no_speed_is_no_speed(clock: PlayClock) -> None:
    with pytest.raises(ValueError, match="above 0"):
        clock.speed = 0.0
