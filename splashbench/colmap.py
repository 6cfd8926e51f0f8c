"""pycolmap, imported so that the process can still be asked to end.

Importing pycolmap installs a handler that answers SIGTERM with a stack dump and ends the process on the spot, with
whatever it had half-written. Python's own handler is put back.
"""

from __future__ import annotations

import signal
import threading

import pycolmap

__all__ = ["pycolmap"]

if threading.current_thread() is threading.main_thread():
    _handler = signal.getsignal(signal.SIGTERM)
    if _handler is not None:  # None: not Python's
        signal.signal(signal.SIGTERM, _handler)
