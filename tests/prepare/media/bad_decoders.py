"""Decoders that misbehave, in the place of the worker's own loop."""

import os
import signal
import time


def sleeps(max_memory_bytes: str) -> int:
    """Says nothing."""
    time.sleep(600)
    return 0


def dies(max_memory_bytes: str) -> int:
    """Ends as a decoder does that a file has broken."""
    os.read(0, 1)
    os.kill(os.getpid(), signal.SIGSEGV)
    return 0


def babbles(max_memory_bytes: str) -> int:
    """Says what is no message."""
    os.read(0, 1)
    os.write(1, b"\xff" * 64)
    time.sleep(600)
    return 0


def boasts(max_memory_bytes: str) -> int:
    """States an array of exabytes."""
    os.read(0, 1)
    head = b'{"k": 0, "arrays": [["u1", 1000000000, 1000000000]]}'
    os.write(1, len(head).to_bytes(4, "little") + head)
    time.sleep(600)
    return 0
