"""A worker (worker.py) as whoever gives it work sees it, and what is done where it is killed."""

from __future__ import annotations

import contextlib
import json
import os
import select
import subprocess
import tempfile
import uuid
from collections.abc import Sequence

from splashbench.child import child_command
from splashbench.cluster.environment import MARK
from splashbench.cluster.work import Work
from splashbench.cluster.worker import serve
from splashbench.processes import ends_within, marked_processes

# A worker whose input ends lets its task end for 15 s, and then kills it.
_STOP_SECONDS = 25.0
_POLL_SECONDS = 0.5


class WorkerProcess:
    """A worker. It carries out one piece of work at a time.

    Args:
        modules: what is imported before the first piece of work.
        folders: what it imports from; None for where this process does.
    """

    def __init__(self, modules: Sequence[str], folders: Sequence[str] | None = None) -> None:
        self._mark = uuid.uuid4().hex
        self._log = tempfile.TemporaryFile()  # noqa: SIM115 (closed by `stop`)
        command = child_command(serve, ",".join(modules))
        if folders is not None:
            command[3] = os.pathsep.join(folders)
        self._process = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._log,
            start_new_session=True,
            env={**os.environ, MARK: self._mark},
        )
        self.key, self._why = "", ""

    def fileno(self) -> int:
        """What becomes readable once the work has ended or the worker is lost."""
        assert self._process.stdout is not None
        return self._process.stdout.fileno()

    def start(self, work: Work) -> None:
        """Give it a piece of work."""
        assert self._process.stdin is not None
        self.key = work.key
        given = {
            "task": work.task,
            "file": str(work.file),
            "log": str(work.log),
            "environment": dict(work.environment),
            "memory_bytes": work.needs.memory_bytes,
        }
        with contextlib.suppress(BrokenPipeError):  # `answer` tells
            self._process.stdin.write(json.dumps(given).encode() + b"\n")
            self._process.stdin.flush()

    def answer(self) -> int | None:
        """Wait for the work to end; its exit code, or None where the worker itself was lost. What was below it ends."""
        assert self._process.stdout is not None
        # Python looks at interruptions between two looks only.
        while not select.select([self._process.stdout], [], [], _POLL_SECONDS)[0]:
            pass
        line = self._process.stdout.readline()
        if line:
            return int(json.loads(line)["exit_code"])
        self.ask_to_end()
        code = self._process.wait()
        self._log.seek(0)
        said = self._log.read().decode("utf-8", "replace").strip().splitlines()[-1:]
        self._why = f"its worker was killed by signal {-code}" if code < 0 else " ".join(["its worker ended:", *said])
        self.stop()
        return None

    def why_lost(self) -> str:
        """Why the worker ended, for the user; after `answer` gave None."""
        return self._why

    def ask_to_end(self) -> None:
        """Let the worker end what it carries out, and then itself."""
        assert self._process.stdin is not None
        with contextlib.suppress(OSError):
            self._process.stdin.close()

    def stop(self) -> None:
        """End the worker, and what it carries out; wait until they are gone."""
        self.ask_to_end()
        if not ends_within(self._process, _STOP_SECONDS) or self._process.wait() != 0:
            self._process.kill()
            self._process.wait()
            _kill_marked(self._mark)
        assert self._process.stdout is not None
        self._process.stdout.close()
        self._log.close()


def _kill_marked(mark: str) -> None:
    """Kill whatever inherited `mark`."""
    import psutil

    for process in marked_processes(MARK, mark):
        with contextlib.suppress(psutil.Error):
            process.kill()
