"""Work on this machine, several pieces at once."""

from __future__ import annotations

import select
from collections.abc import Sequence
from dataclasses import replace

from splashbench.cluster.environment import thread_limits
from splashbench.cluster.work import Ended, Needs, Work
from splashbench.cluster.worker_process import WorkerProcess

_WAIT_SECONDS = 0.1


class LocalWorkers:
    """At most `at_once` pieces of work on this machine.

    modules: what each worker imports before its first piece of work.
    """

    def __init__(self, at_once: int, modules: Sequence[str]) -> None:
        self._at_once, self._modules = at_once, modules
        self._idle: list[WorkerProcess] = []
        self._busy: list[WorkerProcess] = []

    def __enter__(self) -> LocalWorkers:
        return self

    def __exit__(self, *of_error: object) -> None:
        workers = (*self._busy, *self._idle)
        for worker in workers:
            worker.ask_to_end()
        for worker in workers:
            worker.stop()
        self._busy, self._idle = [], []

    def room(self, needs: Needs) -> int:
        return self._at_once - len(self._busy)

    def sharing(self, needs: Needs) -> int:
        return self._at_once

    def start(self, work: Work) -> None:
        worker = self._idle.pop() if self._idle else WorkerProcess(self._modules)
        self._busy.append(worker)
        worker.start(replace(work, environment={**thread_limits(work.needs.cores), **work.environment}))

    def wait(self) -> list[Ended]:
        readable, _, _ = select.select(self._busy, [], [], _WAIT_SECONDS)
        ended = []
        for worker in readable:
            self._busy.remove(worker)
            exit_code = worker.answer()
            if exit_code is None:
                ended.append(Ended(worker.key, lost=worker.why_lost()))
            else:
                self._idle.append(worker)
                ended.append(Ended(worker.key, exit_code))
        return ended
