"""Where the processes of a conformance test run: in a folder of their own, marked, and watched from outside."""

from __future__ import annotations

import contextlib
import os
import shutil
import time
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Literal

from splashbench.child import child_command, raise_if_disk_was_full
from splashbench.files import read_model, write_model
from splashbench.harness.conformance import subject
from splashbench.harness.conformance.recording import OpeningWatch, Touch, read_touches
from splashbench.harness.conformance.scene_copies import SceneCopy
from splashbench.harness.conformance.subject import Answer, Order, Subject
from splashbench.harness.watched_process import Watched, watch
from splashbench.processes import marked_processes

#: Every process of a test inherits this variable, with a value of its own: what is left behind is found by it.
_MARK = "SPLASHBENCH_CONFORMANCE"
_POLL_SECONDS = 0.05
#: Until processes that the harness has killed are gone.
_KILLED_SECONDS = 3.0


class Bench:
    """Runs child processes below the folder `work`, and gathers what they touch and leave.

    Attributes:
        touches: what the method touched of the scene, or wrote elsewhere, in any process so far.
        opened: test views that were opened by any process. complete: whether none can have been missed.
        left: processes that left their run's process group and outlived it, each with the run's name.
    """

    def __init__(self, work: Path) -> None:
        self.touches: dict[Touch, None] = {}
        self.opened: dict[Path, None] = {}
        self.complete = True
        self.left: list[str] = []
        self._work = work
        self._mark = uuid.uuid4().hex
        self._count = 0

    def folder(self, name: str) -> Path:
        """A folder of the test, made where it is not yet."""
        folder = self._work / name
        folder.mkdir(parents=True, exist_ok=True)
        return folder

    def child(self, task: Literal["fit", "load"], method: Subject, seed: int, scene: SceneCopy, model: Path) -> Answer:
        """Have a process of its own fit `scene` and save into `model`, or load from there. Scratch folders go."""
        self._count += 1
        work = self.folder(f"child_{self._count}")
        scratch = self.folder(f"child_{self._count}/scratch")
        order = Order(
            task=task,
            subject=method,
            seed=seed,
            training=str(scene.training),
            scene=str(scene.scene),
            model=str(model),
            scratch=str(scratch),
            answer=str(work / "answer.json"),
            progress=str(work / "progress"),
            touches=str(work / "touches"),
        )
        write_model(work / "order.json", order)
        name = f"the process to {task}"
        with self.process(name), OpeningWatch(list(scene.baits)) as openings:
            watched = watch(
                child_command(subject.carry_out, work / "order.json"),
                log=work / "log",
                progress=work / "progress",
                label=f"{method.id}: {task}",
                timeout_seconds=method.timeout_seconds,
                keep_bar=False,
            )
        self.left += [f"{line}, after {name}" for line in watched.strays]
        self.touches |= dict.fromkeys(read_touches(work / "touches"))
        self.opened |= dict.fromkeys(openings.opened)
        self.complete &= openings.complete or not scene.baits
        shutil.rmtree(scratch, ignore_errors=True)  # a model that needs it is not whole
        raise_if_disk_was_full(watched.exit_code, watched.log_tail)
        if watched.exit_code == 0 and (work / "answer.json").is_file():
            return read_model(work / "answer.json", Answer)
        return Answer(ended_in=task, reason=_reason(watched, method.timeout_seconds))

    @contextmanager
    def process(self, name: str) -> Iterator[None]:
        """Processes that start meanwhile are marked, and looked for afterwards; `name` is that of their run."""
        variables = {_MARK: self._mark, "TMPDIR": str(self.folder("temporary"))}
        before = {variable: os.environ.get(variable) for variable in variables}
        os.environ.update(variables)
        try:
            yield
        finally:
            for variable, value in before.items():
                if value is None:
                    del os.environ[variable]
                else:
                    os.environ[variable] = value
            self.left += [f"{line}, after {name}" for line in _killed(self._mark)]


def _reason(watched: Watched, timeout_seconds: float) -> str:
    """Why a process left no answer."""
    if watched.timed_out:
        return f"it took over {timeout_seconds:g} s; give a longer --timeout, or smaller settings"
    last = watched.log_tail[-1] if watched.log_tail else "it said nothing"
    return f"its process ended with exit code {watched.exit_code}: {last}"


def _killed(mark: str) -> list[str]:
    """Kill the processes that carry `mark` and live on after those of the harness; a line for each."""
    import psutil

    def alive() -> list[psutil.Process]:
        return [process for process in marked_processes(_MARK, mark) if process.pid != os.getpid()]

    until = time.monotonic() + _KILLED_SECONDS  # for those that the harness has killed already
    while (left := alive()) and time.monotonic() < until:
        time.sleep(_POLL_SECONDS)
    lines = []
    for process in left:
        with contextlib.suppress(psutil.Error):
            lines.append(f"{process.name()} (process {process.pid})")
            process.kill()
    return lines
