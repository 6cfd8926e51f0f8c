"""pycolmap must not take the process's way to end in good order from it."""

from __future__ import annotations

import os
import signal
import subprocess
import sys

ENDED = """
import os, signal, time
from splashbench.processes import Terminated, terminable
with terminable():
    from splashbench.colmap import pycolmap
    try:
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(10)
    except Terminated:
        print("in good order")
"""


def test_a_process_that_imports_colmap_still_ends_in_good_order() -> None:
    done = subprocess.run([sys.executable, "-c", ENDED], capture_output=True, text=True, env=dict(os.environ))
    assert done.stdout == "in good order\n"
    assert done.stderr == ""


def test_without_a_handler_of_ours_the_default_stays() -> None:
    code = "import splashbench.colmap, os, signal; os.kill(os.getpid(), signal.SIGTERM)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=dict(os.environ))
    assert done.returncode == -signal.SIGTERM
    assert done.stderr == ""
