"""How many threads a kernel is given."""

from __future__ import annotations

import re
from pathlib import Path

from splashbench.native import library, threads
from splashbench.parallel import thread_count


def test_kernels_work_on_as_many_threads_as_asked_for_and_no_longer_than_asked() -> None:
    assert threads.kernel_threads() == min(thread_count(), threads.MAX_THREADS)
    with threads.use_threads(3):
        assert threads.kernel_threads() == 3
        with threads.use_threads(1000):
            assert threads.kernel_threads() == threads.MAX_THREADS
        assert threads.kernel_threads() == 3
    assert threads.kernel_threads() == min(thread_count(), threads.MAX_THREADS)


def header(name: str) -> str:
    """The text of a shared C++ header."""
    return Path(library.__file__).with_name(name).read_text(encoding="utf-8")


def test_python_and_the_kernels_agree_on_the_largest_number_and_on_what_a_status_means() -> None:
    assert f"constexpr int MAX_THREADS = {threads.MAX_THREADS};" in header("threads.h")
    statuses = {name: int(value) for name, value in re.findall(r"SPLASH_(\w+) = (\d)", header("abi.h"))}
    assert statuses == {name: getattr(library, name) for name in ("DONE", "NOT_FINITE", "OUT_OF_MEMORY", "TOO_LARGE")}
