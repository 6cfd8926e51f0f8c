"""The child process of the conformance test, which carries out an order.

Unlike the harness's child it renders in the process that fitted, so that a loaded model can be held against it, and
records what the method touches.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TextIO

from splashbench.errors import SplashbenchError, one_line
from splashbench.files import raise_if_disk_full, read_model, write_model
from splashbench.harness.conformance.messages import Answer, Order, Said
from splashbench.harness.conformance.touched import Recorder
from splashbench.harness.conformance.views import held_geometry, held_particles, look, views_of, window_fault
from splashbench.harness.contract import Run, Support
from splashbench.harness.discovery import load_method
from splashbench.scene import Scene


def carry_out(order_path: str) -> int:
    """Carry out the order; leaves an Answer behind unless the process dies or the disk is full."""
    order, answer = read_model(Path(order_path), Order), Answer()
    recorder = Recorder(
        Path(order.touched),
        scene=Path(order.scene),
        allowed=_shown(Path(order.view)),
        writable=[Path(order.scratch), Path(order.model)],
    )
    try:
        with Path(order.progress).open("a", encoding="utf-8") as stream, recorder.method():
            _answer(order, answer, _Reporter(stream, answer.said))
    except Exception as error:
        raise_if_disk_full(getattr(error, "filename", None) or order.model, error)
        answer.clear = isinstance(error, SplashbenchError)
        text = one_line(str(error))[:300]
        answer.reason = text if answer.clear else f"{type(error).__name__}: {text}"
    write_model(Path(order.answer), answer)
    return 0


def _shown(view: Path) -> set[str]:
    """The files that a training view leads to, resolved."""
    return {os.path.realpath(Path(root, name)) for root, _, names in os.walk(view) for name in names}


def _answer(order: Order, answer: Answer, reporter: _Reporter) -> None:
    answer.stage = "import"
    method = load_method(order.subject.method)
    scene = Scene.open(Path(order.view)).training()
    views = views_of(scene)
    if order.do == "fit":
        answer.stage = "supports"
        support = method.supports(scene)
        if not isinstance(support, Support):
            raise TypeError(f"supports() returned {type(support).__name__}, not a Support")
        if not support.ok:
            answer.reason, answer.clear = one_line(support.reason), bool(support.reason.strip())
            return
        answer.stage = "fit"
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
    else:
        answer.stage = "load"
        fitted = method.load(Path(order.model), scene)
    if order.do == "fit":
        # Before rendering, as in a run: what rendering leaves behind in memory is no part of the model.
        answer.stage = "save"
        fitted.save(Path(order.model))
    answer.stage = "render"
    answer.views = look(fitted, views)
    answer.particles = held_particles(fitted, scene.n_frames)
    answer.geometry = held_geometry(fitted, scene.n_frames)
    if order.do == "fit":
        with _quietly():
            answer.window_fault = window_fault(fitted, scene)
    else:
        answer.again = {name: seen.digest for name, seen in look(fitted, views[::-1]).items()}
    answer.stage = ""


@contextmanager
def _quietly() -> Iterator[None]:
    """What fails here has failed among the views as well, and is told there."""
    try:
        yield
    except Exception as error:
        print(error, file=sys.stderr)


class _Reporter:
    """Passes progress on to the bar, and keeps what it was like."""

    def __init__(self, stream: TextIO, said: Said) -> None:
        self._stream, self._said, self._last = stream, said, 0.0

    def __call__(self, fraction: float, message: str) -> None:
        said = self._said
        said.reports += 1
        said.messages += bool(message.strip())
        if not said.fault:
            if not 0 <= fraction <= 1:
                said.fault = f"report {said.reports} is {fraction:g}, outside [0, 1]"
            elif fraction < self._last:
                said.fault = f"report {said.reports} goes back from {self._last:g} to {fraction:g}"
        self._last = fraction
        self._stream.write(f"{fraction:.4f} {' '.join(message.split())}\n")
        self._stream.flush()
