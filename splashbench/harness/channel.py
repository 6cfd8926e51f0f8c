"""What a method's process tells its keeper: marks as they happen, and last how the phase ended (keeper.py).

The line belongs to the method's process, so a method can write into it. The keeper therefore stamps every mark by when
it comes, and the harness judges by what it sees from outside (clock.py, outputs.py).
"""

from __future__ import annotations

import json
import socket
import threading
import time
from typing import Any

#: Marks of a fit, in their order; a fit may be paused and go on any number of times.
FIT_STARTS, PAUSED, GOES_ON, FIT_ENDS, SAVED = "fit starts", "paused", "goes on", "fit ends", "saved"
#: Marks around the renders that are timed.
TIMING_STARTS, TIMING_ENDS = "timing starts", "timing ends"


class Channel:
    """The end of the line in the method's process; without a socket it tells nobody."""

    def __init__(self, line: socket.socket | None = None) -> None:
        self._line, self._lock = line, threading.Lock()

    def mark(self, name: str) -> None:
        """Tell that something happens now, and when that is by the clock that all processes share."""
        self._send({"mark": name, "at": time.monotonic()})

    def finish(self, outcome: dict[str, Any]) -> None:
        """Tell how the phase ended: the fields of a `messages.Outcome`."""
        self._send({"outcome": outcome})

    def _send(self, message: dict[str, Any]) -> None:
        if self._line is not None:
            with self._lock:
                self._line.sendall(json.dumps(message).encode() + b"\n")
