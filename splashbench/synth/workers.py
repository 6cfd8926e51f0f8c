"""Processes that film: each does one thing after another, and a camera's frames stay with one of them where they can.

To set up a camera (`splashbench.synth.imaging.rendering.RoomView`) takes as long as many of its frames. So a process
goes on with its camera. Once no camera is left it helps the one that has most to do, from the end, and all of them are
done at about the same time.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from typing import Any, Generic, TypeVar

from splashbench.errors import SplashbenchError
from splashbench.processes import end_with_parent
from splashbench.progress import track

Given = TypeVar("Given")
Job = tuple[Callable[..., Any], tuple[Any, ...]]

# Frames that are handed out at a time: many enough for the bar to be cheap, and few enough for all to end together.
_BLOCK = 5
# Of a camera that has fewer blocks left than this nobody takes one away, as it would have to be set up for it.
_WORTH_HELPING = 2
# Of the memory that is free, workers take this share at most.
_SHARE_OF_MEMORY = 0.8


def worker_count(each_bytes: int, most: int) -> int:
    """Processes that this machine has the cores for, and the memory, where one takes `each_bytes`: 1 to `most`."""
    import psutil

    room = int(_SHARE_OF_MEMORY * psutil.virtual_memory().available) // max(each_bytes, 1)
    return max(1, min(len(os.sched_getaffinity(0)), room, most))


class Workers(Generic[Given]):
    """`count` processes, each with its copy of `given`, which functions get first; for 1, the calling process itself.

    made: what is lost where a process dies, for the message. `each` and `film` raise SplashbenchError then.
    """

    def __init__(self, count: int, given: Given, made: str) -> None:
        self._given, self._made = given, made
        self._executors: list[ProcessPoolExecutor] = []
        if count > 1:
            # Spawned, not forked: the libraries used here start threads, which a fork would leave undefined.
            context = multiprocessing.get_context("spawn")
            self._executors = [
                ProcessPoolExecutor(1, mp_context=context, initializer=_begin, initargs=(given,)) for _ in range(count)
            ]

    def __enter__(self) -> Workers[Given]:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: object) -> None:
        if kind is not None:
            # To wait for what is under way would take minutes.
            for process in multiprocessing.active_children():
                process.terminate()
        for executor in self._executors:
            executor.shutdown()

    def each(self, jobs: Sequence[Job], description: str) -> list[Any]:
        """What function(given, *arguments) returns for each of `jobs`, in their order."""
        waiting = deque(enumerate(jobs))
        results: list[Any] = [None] * len(jobs)

        def after(job: tuple[int, Job], result: Any) -> None:
            results[job[0]] = result

        made = self._made_in_turn(lambda worker: waiting.popleft() if waiting else None, lambda job: job[1], after)
        for _ in track(made, description, total=len(jobs)):
            pass
        return results

    def film(
        self,
        frames: Mapping[str, int],
        shoot: Callable[[Given, str, range], Any],
        description: str,
        finish: Callable[[Given, str], Any] | None = None,
    ) -> list[Any]:
        """Film so many frames with each camera; what `shoot` returned of some frames of a camera, in no order.

        finish: is called once all frames of a camera are there.
        """
        reels, results = Reels(frames), list[Any]()

        def job(chosen: tuple[str, range | None]) -> Job:
            camera, block = chosen
            if block is not None:
                return shoot, (camera, block)
            assert finish is not None
            return finish, (camera,)

        def after(chosen: tuple[str, range | None], result: Any) -> None:
            camera, block = chosen
            if block is not None:
                results.append(result)
                reels.shot(camera, finish is not None)

        made = self._made_in_turn(reels.next, job, after)
        for _ in track(made, description, total=reels.blocks + (len(frames) if finish is not None else 0)):
            pass
        return results

    def _made_in_turn(
        self,
        choose: Callable[[int], Any],
        job: Callable[[Any], Job],
        after: Callable[[Any, Any], None],
    ) -> Iterator[None]:
        """Give every process (by its number) what `choose` has for it, until there is nothing; yields once for each."""
        if not self._executors:
            while (chosen := choose(0)) is not None:
                function, arguments = job(chosen)
                after(chosen, function(self._given, *arguments))
                yield
            return
        at_work: dict[Future[Any], tuple[int, Any]] = {}
        idle = set(range(len(self._executors)))
        try:
            while True:
                for worker in sorted(idle):
                    if (chosen := choose(worker)) is not None:
                        idle.remove(worker)
                        at_work[self._executors[worker].submit(_call, *job(chosen))] = worker, chosen
                if not at_work:
                    return
                for done in wait(at_work, return_when=FIRST_COMPLETED).done:
                    worker, chosen = at_work.pop(done)
                    idle.add(worker)
                    after(chosen, done.result())
                    yield
        except BrokenProcessPool:
            raise SplashbenchError(
                f"a worker process died while making {self._made}, most likely for want of memory; "
                "give a smaller --size, fewer --workers, or close other programs"
            ) from None


class Reels:
    """The blocks of frames that are left to film with each camera. `frames`: how many each camera films in all."""

    def __init__(self, frames: Mapping[str, int]) -> None:
        self._left = {
            camera: deque(range(start, min(start + _BLOCK, count)) for start in range(0, count, _BLOCK))
            for camera, count in frames.items()
        }
        #: how many blocks there are in all
        self.blocks = sum(map(len, self._left.values()))
        self._missing = {camera: len(left) for camera, left in self._left.items()}
        self._untouched = deque(self._left)
        self._finished: deque[str] = deque()
        self._at: dict[int, tuple[str, bool]] = {}

    def next(self, worker: int) -> tuple[str, range | None] | None:
        """What this process does next: a camera and its frames, or None for its end; None where nothing is left."""
        if self._finished:
            return self._finished.popleft(), None
        camera, helps = self._at.get(worker, ("", False))
        if not self._left.get(camera):
            most = max(self._left, key=lambda name: len(self._left[name]), default="")
            if self._untouched:
                camera, helps = self._untouched.popleft(), False
            elif most and len(self._left[most]) >= _WORTH_HELPING:
                camera, helps = most, True
            else:
                return None
            self._at[worker] = camera, helps
            if not self._left[camera]:  # of no frames
                return self.next(worker)
        left = self._left[camera]
        return camera, left.pop() if helps else left.popleft()

    def shot(self, camera: str, to_finish: bool) -> None:
        """One of its blocks is there."""
        self._missing[camera] -= 1
        if to_finish and self._missing[camera] == 0:
            self._finished.append(camera)


_given: Any = None


def _begin(given: Any) -> None:
    """Keep a process to one core, as all together fill the machine, and let it end with its parent."""
    import cv2

    global _given
    end_with_parent()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches all of them; the parent alone answers
    cv2.setNumThreads(1)
    _given = given


def _call(function: Callable[..., Any], arguments: tuple[Any, ...]) -> Any:
    return function(_given, *arguments)
