"""Where the processes of a conformance test run: in a folder of their own, marked, and watched from outside."""

from __future__ import annotations

import os
import shutil
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Literal

from splashbench.child import child_command, raise_if_disk_was_full
from splashbench.files import read_model, write_model
from splashbench.harness.conformance import child
from splashbench.harness.conformance.messages import Answer, Order, Subject
from splashbench.harness.conformance.opening import Opening
from splashbench.harness.conformance.scenes import Place
from splashbench.harness.conformance.stopping import MARK, processes_left
from splashbench.harness.conformance.touched import Touch, read_touched
from splashbench.harness.process import Watched, watch


class Bench:
    """Runs child processes below the folder `work`, and gathers what they touch and leave.

    Attributes:
        touches: what the method touched of the scene, or wrote elsewhere, in any process so far.
        opened: test views that were opened by any process. watched: whether none can have been missed.
        left: processes that left their run's process group and outlived it, each with the run's name.
    """

    def __init__(self, work: Path) -> None:
        self.touches: dict[Touch, None] = {}
        self.opened: dict[Path, None] = {}
        self.watched = True
        self.left: list[str] = []
        self._work = work
        self._mark = uuid.uuid4().hex
        self._count = 0

    def folder(self, name: str) -> Path:
        """A folder of the test, made where it is not yet."""
        folder = self._work / name
        folder.mkdir(parents=True, exist_ok=True)
        return folder

    def child(self, do: Literal["fit", "load"], subject: Subject, seed: int, place: Place, model: Path) -> Answer:
        """Have a process of its own fit `place` and save into `model`, or load from there. Scratch folders go."""
        self._count += 1
        work = self.folder(f"child_{self._count}")
        scratch = self.folder(f"child_{self._count}/scratch")
        order = Order(
            do=do,
            subject=subject,
            seed=seed,
            view=str(place.view),
            scene=str(place.scene),
            model=str(model),
            scratch=str(scratch),
            answer=str(work / "answer.json"),
            progress=str(work / "progress"),
            touched=str(work / "touched"),
        )
        write_model(work / "order.json", order)
        what = f"the process to {do}"
        with self.process(what), Opening(list(place.baits)) as opening:
            watched = watch(
                child_command(child.carry_out, work / "order.json"),
                log=work / "log",
                progress=work / "progress",
                label=f"{subject.id}: {do}",
                timeout_seconds=subject.timeout_seconds,
                keep_bar=False,
            )
        self.left += [f"{line}, after {what}" for line in watched.strays]
        self.touches |= dict.fromkeys(read_touched(work / "touched"))
        self.opened |= dict.fromkeys(opening.seen)
        self.watched &= opening.complete or not place.baits
        shutil.rmtree(scratch, ignore_errors=True)  # a model that needs it is not whole
        raise_if_disk_was_full(watched.exit_code, watched.log_tail)
        if watched.exit_code == 0 and (work / "answer.json").is_file():
            return read_model(work / "answer.json", Answer)
        return Answer(stage=do, reason=_died(watched, subject.timeout_seconds))

    @contextmanager
    def process(self, what: str) -> Iterator[None]:
        """Processes that start meanwhile are marked, and looked for afterwards; `what` names them."""
        ours = {MARK: self._mark, "TMPDIR": str(self.folder("temporary"))}
        before = {name: os.environ.get(name) for name in ours}
        os.environ.update(ours)
        try:
            yield
        finally:
            for name, value in before.items():
                if value is None:
                    del os.environ[name]
                else:
                    os.environ[name] = value
            self.left += [f"{line}, after {what}" for line in processes_left(self._mark)]


def _died(watched: Watched, timeout_seconds: float) -> str:
    if watched.timed_out:
        return f"it took over {timeout_seconds:g} s; give a longer --timeout, or smaller settings"
    last = watched.log_tail[-1] if watched.log_tail else "it said nothing"
    return f"its process ended with exit code {watched.exit_code}: {last}"
