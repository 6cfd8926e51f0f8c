"""Fixtures that the whole suite shares: a small scene with known truth, and the folder of real test data."""

from __future__ import annotations

import os
import shutil
import signal
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType

import pytest
from filelock import FileLock

from splashbench.files import atomic_directory
from splashbench.scene import Scene
from splashbench.study import stress
from splashbench.synth.balls import write_balls_scene

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    # A shell's jobs in the background ignore it, and so would the commands that tests interrupt.
    signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(scope="session", autouse=True)
def _empty_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """What a developer has fetched once, such as LPIPS weights, changes no test."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SPLASHBENCH_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture(scope="session", autouse=True)
def _short_reference() -> Iterator[None]:
    """The control `nothing` of studies and benchmarks is fitted in 20 steps: nobody looks at it here."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(stress, "REFERENCE_SETTINGS", {"iterations": 20})
        yield


@pytest.fixture(scope="session")
def once(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str, Callable[[Path], None]], Path]:
    """Makes a folder once for all processes that run tests: the first fills it, the others wait; read-only."""
    base = tmp_path_factory.getbasetemp()
    shared = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base

    def made(name: str, make: Callable[[Path], None]) -> Path:
        place = shared / name
        with FileLock(f"{place}.lock"):
            if not place.is_dir():
                with atomic_directory(place) as folder:
                    make(folder)
        return place

    return made


@pytest.fixture(scope="session")
def balls_directory(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A scene of balls in free flight; read-only, shared by all tests. Use `balls_copy` to change something."""
    directory = tmp_path_factory.mktemp("scenes") / "balls"
    write_balls_scene(directory)
    return directory


@pytest.fixture(scope="session")
def balls(balls_directory: Path) -> Scene:
    """The shared scene of balls."""
    return Scene.open(balls_directory)


@pytest.fixture
def balls_copy(balls_directory: Path, tmp_path: Path) -> Path:
    """A copy of the scene that the test may damage."""
    return Path(shutil.copytree(balls_directory, tmp_path / "balls"))


@pytest.fixture
def no_hang() -> Iterator[None]:
    """Ends a test after a minute: opening a pipe that nobody writes to waits for ever."""

    def stop(number: int, frame: FrameType | None) -> None:
        raise TimeoutError("this hangs")

    before = signal.signal(signal.SIGALRM, stop)
    signal.alarm(60)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


@pytest.fixture(scope="session")
def test_data() -> Path:
    """The folder of real test data; the test skips where it is not at hand."""
    folder = os.environ.get("SPLASHBENCH_TEST_DATA")
    if not folder or not Path(folder).is_dir():
        pytest.skip("SPLASHBENCH_TEST_DATA is not set to a folder with real test data")
    return Path(folder)
