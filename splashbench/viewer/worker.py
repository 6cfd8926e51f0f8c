"""The worker: one thread on which everything slow is made, the most urgent first.

Once the viewer runs, models are asked on this thread alone, so that no two questions reach one at the same time.
"""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable

#: Returns the next piece of work, or None where there is nothing to do.
NextJob = Callable[[], Callable[[], None] | None]


class Worker:
    """Runs what `next_job` returns, one after the other; sleeps where there is nothing until `wake` is called."""

    def __init__(self, next_job: NextJob) -> None:
        self._next_job = next_job
        self._state = threading.Condition()
        # Whether somebody has called since it last asked for work; whether it found none; whether it is to end.
        self._called, self._idle, self._stopped = True, False, False
        self._thread = threading.Thread(target=self._run, name="viewer worker", daemon=True)

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def wake(self) -> None:
        """There may be something to do."""
        with self._state:
            self._called, self._idle = True, False
            self._state.notify_all()

    def wait_idle(self, seconds: float) -> bool:
        """Wait until there is nothing to do, for `seconds` at the most; whether that came."""
        with self._state:
            return self._state.wait_for(lambda: self._idle or self._stopped, seconds)

    def stop(self) -> None:
        """End after the present piece of work; waits a moment for it."""
        with self._state:
            self._stopped = True
            self._state.notify_all()
        if self._thread.is_alive():
            self._thread.join(timeout=5.0)

    def _run(self) -> None:
        while True:
            with self._state:
                self._called = False
                if self._stopped:
                    return
            if self._do_next():
                continue
            with self._state:
                # A call that came while it looked for work may be of work that it did not see.
                if not self._called:
                    self._idle = True
                    self._state.notify_all()
                    self._state.wait_for(lambda: self._called or self._stopped)

    def _do_next(self) -> bool:
        """Do the next piece of work; whether there was one. One that raises is told, and waits for the next call."""
        try:
            job = self._next_job()
            if job is not None:
                job()
            return job is not None
        except Exception as error:
            print(f"the viewer could not do that: {type(error).__name__}: {error}", file=sys.stderr)
            return False
