"""Media files read through a child process, which is held to limits of memory and time.

FFmpeg believes what a file states of itself, and its readers are many. A file that asks for gigabytes, that never
ends, or that breaks the decoder costs the child, and one line tells of it. It is no wall: code that a file made FFmpeg
run would have the user's rights.

A child is kept for the next file, since starting one costs a quarter of a second. It decodes ahead while the frame
before is looked at.
"""

from __future__ import annotations

import atexit
import os
import subprocess
import threading
from collections.abc import Generator, Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splashbench.child import child_command
from splashbench.errors import SplashbenchError
from splashbench.processes import has_ended

from .container import COPY_AGAIN, Chapter, VideoInfo, damaged
from .messages import EndedError, Message, SilenceError, receive, send
from .worker import MAX_MEMORY_BYTES, serve

#: How long a child may work on a file without a sign of life, and how long it may take to start.
PATIENCE_S, START_S = 45.0, 120.0
_PIPE_BYTES = 1 << 20
_END_SECONDS = 5.0
_MAX_FAULT = 1000


def probe(path: Path) -> VideoInfo:
    """Read a file's headers and its first frame. Raises SplashbenchError when it is unreadable or holds no video."""
    with _as_it_should_be(path):
        ((head, _),) = _asked({"task": "probe", "path": str(path)})
        return VideoInfo(**head)


def scan(path: Path) -> Chapter:
    """Read the packets of a file without decoding them. Raises SplashbenchError when fewer are there than promised."""
    with _as_it_should_be(path):
        ((head, (pts, entries)),) = _asked({"task": "scan", "path": str(path)})
        return Chapter(Path(path), pts, head["time_base"], head["duration"], entries, head["version"])


def frames(chapter: Chapter, wanted: Sequence[int] | NDArray[np.int64]) -> Iterator[tuple[int, NDArray[np.uint8]]]:
    """Yield (index, sRGB uint8 [H, W, 3]) of the frames `wanted`, which increase.

    Frames equal those of a decode from the beginning, bit for bit: the decoder only ever starts at
    pictures that the coding standards make independent of the past. Raises SplashbenchError when a frame
    cannot be decoded.
    """
    return _images(chapter, {"task": "frames"}, [np.asarray(wanted, np.int64)])


def luma(
    chapter: Chapter, width: int, first: int, last: int, keyframes: bool = False
) -> Iterator[tuple[int, NDArray[np.uint8]]]:
    """Yield (index, luma uint8 [h, width]) of the frames first..last that decode, shrunk by area."""
    return _images(chapter, {"task": "luma", "width": width, "first": first, "last": last, "keyframes": keyframes}, [])


def sound(path: Path) -> list[tuple[float, int, NDArray[np.float32]]]:
    """A file's first sound track: contiguous pieces of (first sample in the file's own time, rate, mono samples)."""
    pieces: list[tuple[float, int, list[NDArray[np.float32]]]] = []
    with closing(_asked({"task": "sound", "path": str(path)})) as blocks, _as_it_should_be(path):
        for head, (samples,) in blocks:
            if head["time"] is not None:
                pieces.append((float(head["time"]), int(head["rate"]), []))
            pieces[-1][2].append(samples)
    if not pieces:
        raise SplashbenchError(f"{path} has an audio track without a single sample; {COPY_AGAIN}")
    return [(time, rate, np.concatenate(samples)) for time, rate, samples in pieces]


def _images(
    chapter: Chapter, request: dict[str, Any], more: Sequence[NDArray[Any]]
) -> Iterator[tuple[int, NDArray[np.uint8]]]:
    facts = {"time_base": chapter.time_base, "duration": chapter.duration, "version": chapter.version}
    asked = _asked({"path": str(chapter.path), **facts, **request}, [chapter.pts, chapter.entries, *more])
    with closing(asked) as answers:
        for answer in answers:
            with _as_it_should_be(chapter.path):
                head, (image,) = answer
                k = int(head["k"])
            yield k, image


@contextmanager
def _as_it_should_be(path: Path) -> Iterator[None]:
    """Tell where a child's answer is none to what it was asked: a file has broken it."""
    try:
        yield
    except (TypeError, ValueError, KeyError, IndexError):
        _children.end()
        raise SplashbenchError(damaged(path, "the decoder says what makes no sense")) from None


def _asked(request: dict[str, Any], arrays: Sequence[NDArray[Any]] = ()) -> Generator[Message]:
    """Yield the answers of a child to `request`. Raises SplashbenchError with what is wrong with the file."""
    path = Path(request["path"])
    if not path.is_absolute():
        request |= {"folder": _here(path)}  # a child stays where it was started
    while True:
        child, is_free = _children.take(path), False
        is_kept = child.is_ready  # from a file before
        has_answered = False
        try:
            if not child.is_ready:
                child.start(path)
            send(child.requests, request, arrays, PATIENCE_S)
            while True:
                head, found = receive(child.answers, PATIENCE_S)
                has_answered = True
                if "done" in head:
                    is_free = True
                    return
                if "fault" in head:
                    is_free = "worn" not in head  # what was in want of memory may not have given it back
                    raise SplashbenchError(" ".join(str(head["fault"]).split("\n"))[:_MAX_FAULT])
                if "tick" not in head:
                    yield head, found
        except SilenceError:
            raise SplashbenchError(damaged(path, f"nothing came of it for {PATIENCE_S:.0f} s")) from None
        except EndedError:
            if is_kept and not has_answered:
                continue  # it may have been killed while it waited: not this file's doing
            raise SplashbenchError(damaged(path, child.how_it_ended())) from None
        finally:
            _children.give_back(child, is_free)


def _here(path: Path) -> str:
    try:
        return str(Path.cwd())
    except FileNotFoundError:
        raise SplashbenchError(f"{path} does not exist, since the current folder was removed; go to another") from None


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
        os.set_blocking(self.requests, False)
        _enlarge(self.answers)
        self.is_ready = False

    def start(self, path: Path) -> None:
        """Wait until it can be asked. Raises SplashbenchError naming `path`, whose fault it is not."""
        try:
            receive(self.answers, START_S)
        except (EndedError, SilenceError):
            raise SplashbenchError(
                f"{path} was not read: the process that decodes did not start ({self.how_it_ended()}); free some"
                " memory, or raise the limits of this shell (ulimit -v)"
            ) from None
        self.is_ready = True

    def is_alive(self) -> bool:
        return not has_ended(self._process)

    def how_it_ended(self) -> str:
        """In words, once it says no more."""
        with suppress(subprocess.TimeoutExpired):
            return f"the decoder ended with {self._process.wait(_END_SECONDS)}"
        return "the decoder broke off"

    def end(self) -> None:
        self._process.kill()
        self._process.wait()
        self._close()

    def forget(self) -> None:
        """Leave it to the process that has started it, which this one was forked off."""
        self._process.returncode = 0  # else the garbage collector warns that it still runs
        self._close()

    def _close(self) -> None:
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe is not None:
                pipe.close()


def _enlarge(descriptor: int) -> None:
    """Let the pipe hold more, where the system can: fewer turns for a picture of megabytes."""
    import fcntl

    with suppress(OSError, AttributeError):
        fcntl.fcntl(descriptor, fcntl.F_SETPIPE_SZ, _PIPE_BYTES)


class _Children:
    """The child that waits for a file. A process that is forked off has none of its parent's."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._idle: list[_Child] = []

    def take(self, path: Path) -> _Child:
        with self._lock:
            while self._idle:
                child = self._idle.pop()
                if child.is_alive():
                    return child
                child.end()
        try:
            return _Child()
        except OSError as error:
            raise SplashbenchError(
                f"{path} was not read: no process could be started ({error.strerror}); close other programs, or raise"
                " the limits of this shell (ulimit -n, ulimit -u)"
            ) from None

    def give_back(self, child: _Child, is_free: bool) -> None:
        with self._lock:
            if is_free and not self._idle:
                self._idle.append(child)
                return
        child.end()  # what it still has to say is nobody's

    def end(self) -> None:
        with self._lock:
            idle, self._idle = self._idle, []
        for child in idle:
            child.end()

    def forget(self) -> None:
        idle, self._idle, self._lock = self._idle, [], threading.Lock()
        for child in idle:
            child.forget()


_children = _Children()
end_children = _children.end
atexit.register(end_children)
os.register_at_fork(after_in_child=_children.forget)
