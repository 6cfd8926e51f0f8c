"""Processes that film: every frame once, a camera with one process where it can, and nothing left after a failure."""

from __future__ import annotations

import multiprocessing
import operator
import os
from pathlib import Path

import psutil
import pytest

from splashbench.errors import SplashbenchError
from splashbench.synth.scenes import make_scene
from splashbench.synth.workers import Reels, Workers, worker_count


def played(frames: dict[str, int], speeds: list[int], to_finish: bool = True) -> list[tuple[int, str, range | None]]:
    """Who did what, in order of its start, where process w takes `speeds[w]` ticks for a block."""
    reels, done = Reels(frames), []
    busy: dict[int, tuple[int, str, range | None]] = {}
    for tick in range(10_000):
        for worker, (end, camera, block) in list(busy.items()):
            if end == tick:
                del busy[worker]
                if block is not None:
                    reels.shot(camera, to_finish)
        for worker, speed in enumerate(speeds):
            if worker not in busy and (chosen := reels.next(worker)) is not None:
                busy[worker] = (tick + speed, *chosen)
                done.append((worker, *chosen))
        if not busy:
            return done
    raise AssertionError("it never ends")


@pytest.mark.parametrize("speeds", [[1], [1, 1], [1, 3], [2, 3, 5], [1] * 9, [7, 1, 1, 4]])
@pytest.mark.parametrize("counts", [[50] * 7, [3], [1, 1, 1], [4, 31, 267, 5, 0, 6]])
def test_every_frame_is_filmed_once_and_every_camera_ends_after_its_frames(
    speeds: list[int], counts: list[int]
) -> None:
    frames = {str(number): count for number, count in enumerate(counts)}
    seen: dict[str, list[int]] = {camera: [] for camera in frames}
    for _, camera, block in played(frames, speeds):
        if block is None:
            assert sorted(seen[camera]) == list(range(frames[camera]))
            seen[camera].append(-1)
        else:
            seen[camera] += block
    for camera, count in frames.items():
        assert sorted(seen[camera]) == list(range(-1 if count else 0, count))


def test_two_processes_film_three_cameras_each_and_share_the_seventh() -> None:
    done = played(dict.fromkeys("1234567", 50), [1, 1], to_finish=False)
    cameras = [{camera for worker, camera, _ in done if worker == number} for number in (0, 1)]
    assert cameras[0] & cameras[1] == {"7"}
    assert len(cameras[0]) == len(cameras[1]) == 4
    blocks = [sum(worker == number for worker, _, _ in done) for number in (0, 1)]
    assert blocks == [35, 35]
    # The one that helps begins at the end: the other goes on where it is.
    seventh = [(worker, block) for worker, camera, block in done if camera == "7" and block is not None]
    first = [block.start for worker, block in seventh if worker == seventh[0][0]]
    second = [block.start for worker, block in seventh if worker != seventh[0][0]]
    assert first == sorted(first)
    assert second == sorted(second, reverse=True)


def test_nobody_sets_up_a_camera_for_its_last_block() -> None:
    done = played({"1": 5, "2": 10}, [1, 1], to_finish=False)
    assert [worker for worker, camera, _ in done if camera == "2"] == [1, 1]


@pytest.mark.parametrize("count", [1, 2])
def test_jobs_are_done_in_any_number_of_processes(count: int) -> None:
    with Workers(count, 10, made="sums") as workers:
        assert workers.each([(operator.add, (number,)) for number in range(20)], "adding") == list(range(10, 30))
        assert workers.each([], "nothing") == []


def test_a_job_that_fails_ends_the_others() -> None:
    with pytest.raises(ZeroDivisionError), Workers(2, 10, made="quotients") as workers:
        workers.each([(operator.floordiv, (number,)) for number in (1, 0, 2)], "dividing")
    assert not multiprocessing.active_children()


def test_a_process_that_dies_is_told_in_a_line() -> None:
    told = pytest.raises(SplashbenchError, match="making here, most likely for want of memory")
    with told, Workers(2, 1, made="here") as workers:
        workers.each([(os._exit, ())], "dying")


@pytest.mark.parametrize(("share", "expected"), [(10, 1), (0.4, 2), (1e-9, 3)])
def test_there_are_as_many_as_cores_and_memory_allow(
    share: float, expected: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: set(range(16)))
    available = psutil.virtual_memory().available
    assert worker_count(int(share * available), most=3) == expected


def test_a_scene_is_the_same_bytes_from_two_processes(tmp_path: Path) -> None:
    pytest.importorskip("embreex")
    one, two = (
        make_scene("glass_tank", tmp_path / str(count), (64, 48), 11, particle_radius=0.006, workers=count)
        for count in (1, 2)
    )
    files = sorted(path.relative_to(one.directory) for path in one.directory.rglob("*") if path.is_file())
    assert len([file for file in files if file.parts[0] == "ims"]) == 77
    assert files == sorted(path.relative_to(two.directory) for path in two.directory.rglob("*") if path.is_file())
    for file in files:
        assert (one.directory / file).read_bytes() == (two.directory / file).read_bytes(), file
