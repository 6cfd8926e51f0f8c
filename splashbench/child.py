"""The one entry of child processes: a task, MODULE:FUNCTION, with its arguments.

A task is a function of the room that needs the process. It takes its arguments as text and returns the exit code. What
all children share is here: they import from where their parent did and from nowhere else, end with it, and report a
full disk by an exit code of its own. Nothing heavy is imported, since an external code's time runs already.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Sequence
from importlib import import_module
from pathlib import Path

from splashbench.errors import DiskFullError
from splashbench.processes import end_with_parent

# With `python -m` and `python -c` the current folder comes first among those that are imported from, and a downloaded
# one may hold a json.py. So the parent's folders are set before anything is imported.
_START = "import sys; sys.path[:] = sys.argv[1].split({separator!r}); del sys.argv[1]; {then}"
_TASK = "from splashbench.child import main; sys.exit(main(*sys.argv[1:]))"
_TOOL = "from splashbench.cli.main import main; sys.exit(main())"
#: Exit code of a child that could not write; the last line of its log says which file, behind _DISK_FULL: a method's
#: own code may end its process with this number, too.
DISK_FULL_EXIT = 28
_DISK_FULL = "splashbench: the disk is full: "


def child_command(task: Callable[..., int], *arguments: str | Path) -> list[str]:
    """The command line of a child process of this one that carries out `task(*arguments)`."""
    name = f"{task.__module__}:{task.__qualname__}"
    return [*_start(_TASK), str(os.getpid()), name, *map(str, arguments)]


def tool_command(*words: str | Path) -> list[str]:
    """The command line `splashbench WORDS...` as a process that imports from where this one does."""
    return [*_start(_TOOL), *map(str, words)]


def _start(then: str) -> list[str]:
    folders = os.pathsep.join(folder for folder in sys.path if folder)  # "" would be wherever the child is
    return [sys.executable, "-c", _START.format(separator=os.pathsep, then=then), folders]


def raise_if_disk_was_full(exit_code: int | None, log: Sequence[str]) -> None:
    """Raise DiskFullError where a child ended for that; `log`: the last lines that it wrote."""
    if exit_code != DISK_FULL_EXIT:
        return
    if not log:  # there was no room for its line
        raise DiskFullError("the disk is full; free some space")
    if log[-1].startswith(_DISK_FULL):
        raise DiskFullError(log[-1].removeprefix(_DISK_FULL))


def main(parent: str, task: str, *arguments: str) -> int:
    """Carry out `task`, MODULE:FUNCTION, for as long as the process `parent` lives."""
    end_with_parent(int(parent))
    module, _, function = task.partition(":")
    try:
        exit_code: int = getattr(import_module(module), function)(*arguments)
    except DiskFullError as error:  # no task's own failure: the parent reads this last line and tells the user
        print(f"{_DISK_FULL}{error}", file=sys.stderr)
        return DISK_FULL_EXIT
    return exit_code
