"""Tasks for the tests of workers: a function per way to behave. The worker imports them by this file's folder."""

import os
import signal
import sys
import time
from pathlib import Path

from splashbench.cluster import worker

worker._END_SECONDS = 1.0  # in the worker's own process; a test need not wait for longer
STARTED = time.monotonic()


def write(file: str) -> int:
    """Writes who it is, into `file`.done."""
    Path(f"{file}.done").write_text(f"{os.getpid()} {os.getppid()} {STARTED} {os.environ.get('OMP_NUM_THREADS')}")
    print("written")
    return 3


def fail(file: str) -> int:
    raise RuntimeError("the matrix is singular")


def die(file: str) -> int:
    os.kill(os.getpid(), signal.SIGKILL)
    return 0


def hang(file: str) -> int:
    """Ignores what it is asked, and has a child that does the same in a session and an environment of its own."""
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    if os.fork() == 0:
        os.setsid()
        os.execve(sys.executable, [sys.executable, "-c", f"import time; time.sleep(600) # {file}"], {})
    Path(f"{file}.done").touch()
    time.sleep(600)
    return 0


def leave(file: str) -> int:
    """Ends well, and leaves a daemon that knows nothing of where it comes from."""
    if os.fork() == 0:
        os.setsid()
        if os.fork() == 0:
            os.execve(sys.executable, [sys.executable, "-c", f"import time; time.sleep(600) # {file}"], {})
        os._exit(0)
    time.sleep(0.3)
    return 0


def eat(file: str) -> int:
    """Takes memory until it is stopped."""
    held = []
    while True:
        held.append(b"1" * 20_000_000)
        time.sleep(0.02)


def leave_a_mark(file: str) -> int:
    """Changes what a next task would see, were it to run in the same process."""
    global STARTED
    STARTED = 0.0
    os.chdir("/")
    os.environ["OMP_NUM_THREADS"] = "77"
    return 0
