"""Decoders that misbehave, in the place of the worker's own loop."""

import os
import signal
import time

from splashbench.prepare.media.messages import send


def fails(max_memory_bytes: str) -> int:
    """Cannot start."""
    return 3


def sleeps(max_memory_bytes: str) -> int:
    """Says nothing."""
    send(1, {"ready": True})
    time.sleep(600)
    return 0


def dies(max_memory_bytes: str) -> int:
    """Ends as a decoder does that a file has broken."""
    send(1, {"ready": True})
    os.read(0, 1)
    os.kill(os.getpid(), signal.SIGSEGV)
    return 0


def babbles(max_memory_bytes: str) -> int:
    """Says what is no message."""
    send(1, {"ready": True})
    os.read(0, 1)
    os.write(1, b"\xff" * 64)
    time.sleep(600)
    return 0


def boasts(max_memory_bytes: str) -> int:
    """States an array of exabytes."""
    send(1, {"ready": True})
    os.read(0, 1)
    head = b'{"k": 0, "arrays": [["u1", 1000000000, 1000000000]]}'
    os.write(1, len(head).to_bytes(4, "little") + head)
    time.sleep(600)
    return 0


def lies(max_memory_bytes: str) -> int:
    """Answers what it was not asked for."""
    send(1, {"ready": True})
    os.read(0, 1)
    send(1, {"width": 3})
    send(1, {"done": True})
    time.sleep(600)
    return 0


def dawdles(max_memory_bytes: str) -> int:
    """Takes a second for each answer."""
    send(1, {"ready": True})
    while os.read(0, 4096):
        for _ in range(20):  # of being awake
            time.sleep(0.05)
        send(1, {"fault": "it has dawdled"})
    return 0
