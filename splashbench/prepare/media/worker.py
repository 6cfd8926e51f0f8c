"""The child process that decodes: it answers requests one after another until its input ends.

The kernel holds it to its memory; who asked watches that it does not fall silent (reading.py).
"""

from __future__ import annotations

import os
import resource
import signal
import threading
import time
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from splashbench.errors import SplashbenchError
from splashbench.processes import limit_memory, outlive_parent

from . import container, frames, sound
from .messages import EndedError, Message, receive, send

#: Of address space.
MAX_MEMORY_BYTES = 4 << 30
# A sign of life, at most so often.
_TICK_SECONDS = 5.0
_PARENT_SECONDS = 0.5
_MAX_FAULT = 300


def serve(max_memory_bytes: str) -> int:
    """Answer requests from the standard input on the standard output."""
    requests, answers = os.dup(0), os.dup(1)
    with Path(os.devnull).open("r+b") as nothing:
        os.dup2(nothing.fileno(), 0)
        os.dup2(nothing.fileno(), 1)  # whatever FFmpeg prints is no answer
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches all of a group; whoever asks decides
    outlive_parent()  # the end of a thread counts as its process's, and one may ask that another has begun with
    threading.Thread(target=_end_with, args=(os.getppid(),), daemon=True).start()
    limit_memory(int(max_memory_bytes))
    try:
        send(answers, {"ready": True})
        while True:
            request, arrays = receive(requests)
            answer(request, arrays, answers)
    except EndedError:
        return 0


def _end_with(parent: int) -> None:
    """End this process with `parent`, whatever a decoder does."""
    while os.getppid() == parent:
        time.sleep(_PARENT_SECONDS)
    os._exit(1)


def answer(request: dict[str, Any], arrays: list[NDArray[Any]], out: int) -> None:
    """Carry out one request: its answers, signs of life between them, and how it ended."""
    tick = _Ticks(out)
    path = Path(request["path"])
    try:
        if request.get("folder"):
            os.chdir(request["folder"])
        for head, found in _answers(request, arrays, tick):
            send(out, head, found)
            tick.heard()
        send(out, {"done": True})
    except SplashbenchError as error:
        send(out, {"fault": str(error)})
    except MemoryError:
        limit = resource.getrlimit(resource.RLIMIT_AS)[0] >> 20
        reason = f"FFmpeg wants more than {limit} MiB of memory for it, or more tracks than it can have"
        send(out, {"fault": container.damaged(path, reason), "worn": True})
    except EndedError:
        raise
    # PyAV fails in any way that Python knows over what FFmpeg hands it from a damaged file.
    except Exception as error:
        said = f"{type(error).__name__}: {error}"[:_MAX_FAULT].encode("utf-8", "replace").decode("utf-8")
        send(out, {"fault": container.damaged(path, " ".join(said.split())), "worn": True})


def _answers(request: dict[str, Any], arrays: list[NDArray[Any]], tick: _Ticks) -> Iterator[Message]:
    path, task = Path(request["path"]), request["task"]
    if task == "probe":
        yield asdict(container.probe(path)), []
    elif task == "scan":
        found = container.scan(path, tick)
        stated = {"time_base": found.time_base, "duration": found.duration, "version": found.version}
        yield stated, [found.pts, found.entries]
    elif task == "sound":
        for time_s, rate, samples in sound.pieces(path, tick):
            yield {"time": time_s, "rate": rate}, [samples]
    else:
        pts, entries, *wanted = arrays
        chapter = container.Chapter(path, pts, request["time_base"], request["duration"], entries, request["version"])
        if task == "frames":
            images = frames.whole(chapter, wanted[0].tolist(), tick)
        else:
            images = frames.luma(
                chapter, request["width"], request["first"], request["last"], request["keyframes"], tick
            )
        for k, image in images:
            yield {"k": k}, [image]


class _Ticks:
    """Signs of life while a request takes its time."""

    def __init__(self, out: int) -> None:
        self._out = out
        self.heard()

    def heard(self) -> None:
        """An answer has just been sent."""
        self._last = time.monotonic()

    def __call__(self) -> None:
        if time.monotonic() - self._last > _TICK_SECONDS:
            send(self._out, {"tick": True})
            self.heard()
