"""Work on several threads: what a thread starts itself ends as well."""

from __future__ import annotations

import threading
from collections.abc import Iterator

import numpy as np
import pytest

from splashbench import parallel


@pytest.fixture
def two_threads(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A pool of two, whatever the machine has."""
    monkeypatch.setattr(parallel, "thread_count", lambda: 2)
    parallel._pool.cache_clear()
    yield
    parallel._pool().shutdown(wait=False)
    parallel._pool.cache_clear()


def squares(values: np.ndarray, found: np.ndarray, start: int, stop: int) -> None:
    found[start:stop] = values[start:stop] ** 2


@pytest.mark.usefixtures("two_threads", "no_hang")
def test_parts_that_a_thread_of_the_pool_asks_for_are_made_by_itself() -> None:
    """Else all threads wait for parts that none is left to make."""
    values = np.arange(100.0)

    def one(number: int) -> tuple[float, set[str]]:
        found, names = np.empty(100), set()

        def kernel(start: int, stop: int) -> None:
            names.add(threading.current_thread().name)
            squares(values, found, start, stop)

        parallel.over_range(kernel, 100)
        return float(found.sum()) + number, names | {threading.current_thread().name}

    found = parallel.each(one, range(20))
    assert [total for total, _ in found] == [float((values**2).sum()) + number for number in range(20)]
    assert all(len(names) == 1 for _, names in found)
    assert parallel.each(lambda n: parallel.each(lambda m: m * n, range(3)), range(4)) == [
        [0, n, 2 * n] for n in range(4)
    ]


@pytest.mark.usefixtures("two_threads", "no_hang")
def test_the_caller_s_work_is_spread() -> None:
    values, found, names = np.arange(1000.0), np.empty(1000), set()

    def kernel(start: int, stop: int) -> None:
        names.add(threading.current_thread().name)
        squares(values, found, start, stop)

    parallel.over_range(kernel, 1000)
    np.testing.assert_array_equal(found, values**2)
    assert threading.current_thread().name not in names
    names.clear()
    parallel.over_range(kernel, 1000, smallest=1000)
    assert names == {threading.current_thread().name}
