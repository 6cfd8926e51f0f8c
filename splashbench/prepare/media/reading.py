"""Media files read through a child process, which is held to limits of memory and time.

FFmpeg believes what a file states of itself, and its readers are many. A file that asks for gigabytes, that never
ends, or that breaks the decoder costs the child, and one line tells of it.

A child is kept for the next file, since starting one costs a quarter of a second. It decodes ahead while the frame
before is looked at.
"""

from __future__ import annotations

import atexit
import os
import subprocess
import threading
from collections.abc import Generator, Iterator, Sequence
from contextlib import closing, suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splashbench.child import child_command
from splashbench.errors import SplashbenchError
from splashbench.files import require_plain_file

from .container import Chapter, VideoInfo, damaged
from .messages import EndedError, SilenceError, receive, send
from .worker import MAX_MEMORY_BYTES, serve

#: How long a child may work on a file without a sign of life.
PATIENCE_S = 45.0
_PIPE_BYTES = 1 << 20
_END_SECONDS = 5.0


def probe(path: Path) -> VideoInfo:
    """Read a file's headers and its first frame. Raises SplashbenchError when it is unreadable or holds no video."""
    ((head, _),) = _asked({"task": "probe", "path": str(path)})
    return VideoInfo(**head)


def scan(path: Path) -> Chapter:
    """Read the packets of a file without decoding them. Raises SplashbenchError when fewer are there than promised."""
    ((head, (pts, entries)),) = _asked({"task": "scan", "path": str(path)})
    return Chapter(Path(path), pts, head["time_base"], head["duration"], entries)


def frames(chapter: Chapter, wanted: Sequence[int] | NDArray[np.int64]) -> Iterator[tuple[int, NDArray[np.uint8]]]:
    """Yield (index, sRGB uint8 [H, W, 3]) of the frames `wanted`, which increase.

    Frames equal those of a decode from the beginning, bit for bit: the decoder only ever starts at
    pictures that the coding standards make independent of the past. Raises SplashbenchError when a frame
    cannot be decoded.
    """
    numbers = np.asarray(wanted, np.int64)
    return _images(chapter, {"task": "frames"}, [numbers])


def luma(
    chapter: Chapter, width: int, first: int, last: int, keyframes: bool = False
) -> Iterator[tuple[int, NDArray[np.uint8]]]:
    """Yield (index, luma uint8 [h, width]) of the frames first..last that decode, shrunk by area."""
    return _images(chapter, {"task": "luma", "width": width, "first": first, "last": last, "keyframes": keyframes}, [])


def sound(path: Path) -> list[tuple[float, int, NDArray[np.float32]]]:
    """A file's first sound track: contiguous pieces of (first sample in the file's own time, rate, mono samples)."""
    pieces: list[tuple[float, int, list[NDArray[np.float32]]]] = []
    with closing(_asked({"task": "sound", "path": str(path)})) as blocks:
        for head, (samples,) in blocks:
            if head["time"] is not None:
                pieces.append((head["time"], head["rate"], []))
            pieces[-1][2].append(samples)
    if not pieces:
        raise SplashbenchError(f"{path} has an audio track without a single sample; copy it from the camera again")
    return [(time, rate, np.concatenate(samples)) for time, rate, samples in pieces]


def _images(
    chapter: Chapter, request: dict[str, Any], more: Sequence[NDArray[Any]]
) -> Iterator[tuple[int, NDArray[np.uint8]]]:
    request |= {"path": str(chapter.path), "time_base": chapter.time_base, "duration": chapter.duration}
    with closing(_asked(request, [chapter.pts, chapter.entries, *more])) as answers:
        for head, (image,) in answers:
            yield head["k"], image


def _asked(request: dict[str, Any], arrays: Sequence[NDArray[Any]] = ()) -> Generator[tuple[dict[str, Any], list[Any]]]:
    """Yield the answers of a child to `request`. Raises SplashbenchError with what is wrong with the file."""
    path = Path(request["path"])
    require_plain_file(path)
    child = _children.take()
    is_free = False
    try:
        send(child.requests, request, arrays)
        while True:
            head, found = receive(child.answers, PATIENCE_S)
            if "done" in head:
                is_free = True
                return
            if "fault" in head:
                is_free = "worn" not in head  # what was in want of memory may not have given it back
                raise SplashbenchError(str(head["fault"]))
            if "tick" not in head:
                yield head, found
    except SilenceError:
        raise SplashbenchError(damaged(path, f"nothing came of it for {PATIENCE_S:.0f} s")) from None
    except EndedError:
        raise SplashbenchError(damaged(path, child.how_it_ended())) from None
    finally:
        _children.give_back(child, is_free)


class _Child:
    """A process that decodes, and the pipes to it."""

    def __init__(self) -> None:
        # A thread's stack counts as memory, and so does what malloc keeps for each.
        environment = os.environ | {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "MALLOC_ARENA_MAX": "2"}
        self._process = subprocess.Popen(
            child_command(serve, str(MAX_MEMORY_BYTES)),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env=environment,
            bufsize=0,
        )
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self.requests, self.answers = self._process.stdin.fileno(), self._process.stdout.fileno()
        _enlarge(self.answers)

    def is_alive(self) -> bool:
        return self._process.poll() is None

    def how_it_ended(self) -> str:
        """In words, once it says no more."""
        with suppress(subprocess.TimeoutExpired):
            return f"the decoder ended with {self._process.wait(_END_SECONDS)}"
        return "the decoder broke off"

    def end(self) -> None:
        self._process.kill()
        self._process.wait()
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe is not None:
                pipe.close()


def _enlarge(descriptor: int) -> None:
    """Let the pipe hold more, where the system can: fewer turns for a picture of megabytes."""
    import fcntl

    with suppress(OSError, AttributeError):
        fcntl.fcntl(descriptor, fcntl.F_SETPIPE_SZ, _PIPE_BYTES)


class _Children(threading.local):
    """Children of this thread that wait for a file: they end with the thread that started them."""

    def __init__(self) -> None:
        self._idle: list[_Child] = []
        self._owner = os.getpid()

    def take(self) -> _Child:
        if self._owner != os.getpid():  # forked off: they are the parent's
            self._idle, self._owner = [], os.getpid()
        while self._idle:
            child = self._idle.pop()
            if child.is_alive():
                return child
        return _Child()

    def give_back(self, child: _Child, is_free: bool) -> None:
        if is_free and not self._idle:
            self._idle.append(child)
        else:  # what it still has to say is nobody's
            child.end()

    def end(self) -> None:
        if self._owner == os.getpid():
            while self._idle:
                self._idle.pop().end()


_children = _Children()


def end_children() -> None:
    """End the children of this thread that wait for a file."""
    _children.end()


atexit.register(end_children)
