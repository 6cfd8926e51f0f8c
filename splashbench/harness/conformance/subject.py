"""The child process of a conformance test: has the method fit or load, and answers what came of it.

Unlike the harness's own it renders in the process that fitted, so that a loaded model can be compared with it, and
records what the method touches.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal, TextIO

from pydantic import BaseModel, ConfigDict, Field

from splashbench.errors import SplashbenchError, one_line
from splashbench.files import raise_if_disk_full, read_model, write_model
from splashbench.harness.conformance.recording import TouchRecorder
from splashbench.harness.conformance.views import (
    RenderedView,
    ReturnedArrays,
    rendered_views,
    requests_of,
    returned_geometry,
    returned_particles,
    window_fault,
)
from splashbench.harness.contract import Run, Support
from splashbench.harness.discovery import load_method
from splashbench.scene import Scene


class Subject(BaseModel):
    """The method under test, with what settings and limits."""

    model_config = ConfigDict(extra="forbid")
    id: str
    method: str
    preset: str
    overrides: dict[str, Any]
    device: str
    timeout_seconds: float


class Order(BaseModel):
    """What a child process is to do: fit, save and render; or load and render. Paths are absolute.

    training: the training copy that the method is given. scene: what it is a copy of.
    """

    model_config = ConfigDict(extra="forbid")
    task: Literal["fit", "load"]
    subject: Subject
    seed: int
    training: str
    scene: str
    model: str
    scratch: str
    answer: str
    progress: str
    touches: str


class ReportedProgress(BaseModel):
    """The progress that a fit reported."""

    model_config = ConfigDict(extra="forbid")
    reports: int = 0
    messages: int = 0
    fault: str = ""


class Answer(BaseModel):
    """How an order ended. Where `ended_in` is not empty, it ended there, for `reason`.

    clear: whether `reason` is one meant for users, of `supports` or a SplashbenchError. again: digests of the same
    views rendered once more, the last one first. window_fault: see views.window_fault.
    """

    model_config = ConfigDict(extra="forbid")
    ended_in: str = ""
    reason: str = ""
    clear: bool = False
    fit_seconds: float = 0.0
    progress: ReportedProgress = Field(default_factory=ReportedProgress)
    views: dict[str, RenderedView] = Field(default_factory=dict)
    again: dict[str, str] = Field(default_factory=dict)
    window_fault: str = ""
    particles: ReturnedArrays = Field(default_factory=ReturnedArrays)
    geometry: ReturnedArrays = Field(default_factory=ReturnedArrays)

    @property
    def done(self) -> bool:
        """Whether everything ordered was done."""
        return not self.ended_in

    @property
    def digests(self) -> dict[str, str]:
        """Everything that the model gave: name -> digest."""
        views = {name: view.digest for name, view in self.views.items()}
        return views | {"its particles": self.particles.digest, "its signed distance": self.geometry.digest}


def carry_out(order_path: str) -> int:
    """Carry out the order; leaves an Answer behind unless the process dies or the disk is full."""
    order, answer = read_model(Path(order_path), Order), Answer()
    recorder = TouchRecorder(
        Path(order.touches),
        scene=Path(order.scene),
        allowed=_training_files(Path(order.training)),
        writable=[Path(order.scratch), Path(order.model)],
    )
    try:
        with Path(order.progress).open("a", encoding="utf-8") as stream, recorder.method():
            _answer(order, answer, _Reporter(stream, answer.progress))
    except Exception as error:
        raise_if_disk_full(getattr(error, "filename", None) or order.model, error)
        answer.clear = isinstance(error, SplashbenchError)
        text = one_line(str(error))[:300]
        answer.reason = text if answer.clear else f"{type(error).__name__}: {text}"
    write_model(Path(order.answer), answer)
    return 0


def _training_files(training: Path) -> set[str]:
    """The files that a training copy leads to, resolved."""
    return {os.path.realpath(Path(root, name)) for root, _, names in os.walk(training) for name in names}


def _answer(order: Order, answer: Answer, reporter: _Reporter) -> None:
    answer.ended_in = "import"
    method = load_method(order.subject.method)
    scene = Scene.open(Path(order.training)).training()
    requests = requests_of(scene)
    if order.task == "fit":
        answer.ended_in = "supports"
        support = method.supports(scene)
        if not isinstance(support, Support):
            raise TypeError(f"supports() returned {type(support).__name__}, not a Support")
        if not support.ok:
            answer.reason, answer.clear = one_line(support.reason), bool(support.reason.strip())
            return
        answer.ended_in = "fit"
        run = Run(
            seed=order.seed,
            device=order.subject.device,
            directory=Path(order.scratch),
            budget_seconds=order.subject.timeout_seconds,
            _report=reporter,
        )
        config = method.Config.preset(order.subject.preset, order.subject.overrides)
        start = time.perf_counter()
        fitted = method.fit(scene, config, run)
        answer.fit_seconds = time.perf_counter() - start
        # Before rendering, as in a run: what rendering leaves behind in memory is no part of the model.
        answer.ended_in = "save"
        fitted.save(Path(order.model))
    else:
        answer.ended_in = "load"
        fitted = method.load(Path(order.model), scene)
    answer.ended_in = "to_device"
    fitted.to_device(order.subject.device)
    answer.ended_in = "render"
    answer.views = rendered_views(fitted, requests)
    answer.particles = returned_particles(fitted, scene.n_frames)
    answer.geometry = returned_geometry(fitted, scene.n_frames)
    if order.task == "fit":
        with _quietly():
            answer.window_fault = window_fault(fitted, scene)
    else:
        answer.again = {name: view.digest for name, view in rendered_views(fitted, requests[::-1]).items()}
    answer.ended_in = ""


@contextmanager
def _quietly() -> Iterator[None]:
    """What fails here has failed among the views as well, and is reported there."""
    try:
        yield
    except Exception as error:
        print(error, file=sys.stderr)


class _Reporter:
    """Passes progress on to the bar, and records its faults in `progress`."""

    def __init__(self, stream: TextIO, progress: ReportedProgress) -> None:
        self._stream, self._progress, self._last = stream, progress, 0.0

    def __call__(self, fraction: float, message: str) -> None:
        progress = self._progress
        progress.reports += 1
        progress.messages += bool(message.strip())
        if not progress.fault:
            if not 0 <= fraction <= 1:
                progress.fault = f"report {progress.reports} is {fraction:g}, outside [0, 1]"
            elif fraction < self._last:
                progress.fault = f"report {progress.reports} goes back from {self._last:g} to {fraction:g}"
        self._last = fraction
        self._stream.write(f"{fraction:.4f} {' '.join(message.split())}\n")
        self._stream.flush()
