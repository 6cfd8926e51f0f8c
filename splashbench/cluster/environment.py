"""Variables of the environment that work is given."""

from __future__ import annotations

import os

from splashbench.processes import RUN_MARK

#: In the environment of a worker and of everything below it, with a value of its own for each worker.
MARK = "SPLASHBENCH_WORKER"
#: Marks of processes, which are each process's own.
_MARKS = (MARK, RUN_MARK)
_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")


def thread_limits(cores: int | None) -> dict[str, str | None]:
    """Variables that hold a piece of work to `cores` threads; none where that is None."""
    return {} if cores is None else dict.fromkeys(_THREADS, str(cores))


def passed_on() -> dict[str, str | None]:
    """This toolkit's own variables, which work on another machine has to have too."""
    return {name: os.environ[name] for name in os.environ if name.startswith("SPLASHBENCH_") and name not in _MARKS}
