"""The method under test, held up in the middle of its fit: what the harness is to stop. Given to `run` as FILE.py:Held.

Environment variables say which method (HELD_METHOD), at which report of progress (HELD_REPORT, from 1; its end where
there are fewer), and which file to write then (HELD_FLAG).
"""

from __future__ import annotations

import functools
import os
import time
from pathlib import Path
from typing import Any

from splashbench.harness.contract import Fitted, Method, Run
from splashbench.harness.discovery import load_method
from splashbench.scene import TrainingScene

METHOD, REPORT, FLAG = (f"SPLASHBENCH_HELD_{name}" for name in ("METHOD", "REPORT", "FLAG"))


def __getattr__(name: str) -> type[Method]:
    if name != "Held":
        raise AttributeError(name)
    return _held(os.environ[METHOD])


@functools.cache
def _held(name: str) -> type[Method]:
    method = type(load_method(name))

    class Held(method):  # type: ignore[valid-type, misc]
        def fit(self, scene: TrainingScene, config: Any, run: Run) -> Fitted:
            report, left = run._report, int(os.environ[REPORT])

            def reporting(fraction: float, message: str) -> None:
                nonlocal left
                if report is not None:
                    report(fraction, message)
                left -= 1
                if left <= 0:
                    _hold()

            run._report = reporting
            super().fit(scene, config, run)
            _hold()
            raise AssertionError

    return Held


def _hold() -> None:
    Path(os.environ[FLAG]).write_text("held", encoding="ascii")
    while True:
        time.sleep(1)
