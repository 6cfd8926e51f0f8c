"""The leaderboard's work grows with the number of results, not with its square (benchmarks/leaderboard.py has figures).

What is counted is calls of Python functions, the same on every machine. Processor time, with a wide margin, sees work
inside one call, such as searching a list, once it outweighs the rest.
"""

import cProfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from splashbench.report.leaderboard import write_leaderboard
from splashbench.report.page import leaderboard_page
from splashbench.report.results import load_results
from splashbench.report.speed_accuracy import machines
from splashbench.report.table import leaderboard_table

COUNTS = (300, 600, 1200)
SCENES, METHODS = 4, 5


def _make(make_result: Any, course: Any, directory: Path, count: int) -> Path:
    """`count` results of five methods and `nothing` on four scenes with as many seeds as it takes; some have failed."""
    for n in range(count):
        rest, m = divmod(n, METHODS + 1)
        seed, s = divmod(rest, SCENES)
        control = m == METHODS
        failed = n % 50 == 7 and not control
        figures = {"psnr": 20.0 + m + 0.01 * (seed % 7), "lpips": 0.05, "miou": 0.7, "storage_bytes": 3e6}
        make_result(
            "nothing" if control else f"method_{m}",
            seed,
            f"scene_{s}",
            "crashed" if failed else "ok",
            "no voxel" if failed else "",
            control=control,
            fit_seconds=60.0 + m,
            checkpoints=() if failed or control else course((6.0, 15.0), (20.0, 17.0 + m)),
            **({} if failed else figures),
        ).save(directory)
    return directory


def _leaderboard(results: Path, out: Path) -> None:
    """What grows in `splashbench leaderboard`: drawing the charts takes as long for few results as for many."""
    sources = load_results(results)
    table = leaderboard_table(sources)
    write_leaderboard(table, sources, out)
    for entry in (entry for machine in machines(sources) for entry in machine.entries):
        entry.summary("psnr")
    leaderboard_page(table, sources)


def _calls_and_seconds(work: Callable[[], object]) -> tuple[int, float]:
    """Calls of Python functions that `work` makes, and its processor seconds."""
    profile = cProfile.Profile()
    start = time.process_time()
    profile.runcall(work)
    seconds = time.process_time() - start
    return sum(entry.callcount for entry in profile.getstats()), seconds


@pytest.fixture
def folders(make_result: Any, course: Any, tmp_path: Path) -> list[Path]:
    return [_make(make_result, course, tmp_path / f"results_{count}", count) for count in COUNTS]


@pytest.mark.slow
def test_work_grows_linearly_with_the_results(folders: list[Path], tmp_path: Path) -> None:
    _leaderboard(folders[0], tmp_path / "first")  # imports and caches
    measured = [_calls_and_seconds(partial(_leaderboard, folder, tmp_path / "out")) for folder in folders]
    few, more, most = (calls for calls, _ in measured)
    # What the second doubling adds over what the first one adds: 2 where linear, 4 where quadratic. 2.1 is one call for
    # every fifth pair of results.
    assert (most - more) / (more - few) < 2.1
    assert measured[-1][1] < 8 * measured[0][1]
