"""The worker: one thread on which everything slow is made, the most urgent first.

Models are asked on this thread alone, so that no two questions reach one at the same time.
"""

from __future__ import annotations

import threading
from collections.abc import Callable

#: Returns the next piece of work, or None where there is nothing to do.
NextJob = Callable[[], Callable[[], None] | None]


class Worker:
    """Runs what `next_job` returns, one after the other; sleeps where there is nothing until `wake` is called."""

    def __init__(self, next_job: NextJob) -> None:
        self._next_job = next_job
        self._something = threading.Event()
        self._idle = threading.Event()
        self._stopped = False
        self._thread = threading.Thread(target=self._run, name="viewer worker", daemon=True)

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def wake(self) -> None:
        """There may be something to do."""
        self._idle.clear()
        self._something.set()

    def wait_idle(self, seconds: float) -> bool:
        """Wait until there is nothing to do, for `seconds` at the most; whether that came."""
        return self._idle.wait(seconds)

    def stop(self) -> None:
        """End after the present piece of work; waits a moment for it."""
        self._stopped = True
        self._something.set()
        self._idle.set()  # whoever waits need not wait longer
        if self._thread.is_alive():
            self._thread.join(timeout=5.0)

    def _run(self) -> None:
        while not self._stopped:
            self._something.clear()
            job = self._next_job()
            if job is not None:
                self._idle.clear()
                job()
            elif not self._something.is_set():
                self._idle.set()
                self._something.wait()
