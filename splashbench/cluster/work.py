"""What is carried out, how it ended, and what every place that carries out work can do.

A piece of work is a task as in `splashbench.child`, with one argument: a file. It runs in a child process of its own.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol


@dataclass(frozen=True)
class Needs:
    """What a piece of work takes of a machine.

    Attributes:
        cores: threads that it may use at once; None for all that the machine has. gpus: whole ones.
        memory_bytes: resident bytes of all its processes together. The largest one is killed where they take more,
            as the system does when memory runs out. None for no limit.
    """

    cores: int | None = None
    gpus: int = 0
    memory_bytes: int | None = None


@dataclass(frozen=True)
class Work:
    """A piece of work.

    Attributes:
        key: names it among all that run at the same time.
        task: MODULE:FUNCTION, which takes `file` and returns an exit code.
        log: what it writes to standard output and standard error.
        environment: variables that are set for it; None for one that is taken away.
    """

    key: str
    task: str
    file: Path
    log: Path
    needs: Needs = field(default_factory=Needs)
    environment: Mapping[str, str | None] = field(default_factory=dict)


@dataclass(frozen=True)
class Ended:
    """How a piece of work ended.

    Attributes:
        exit_code: negative for a signal.
        lost: why nobody knows how it ended, such as a machine that is gone; then `exit_code` says nothing.
    """

    key: str
    exit_code: int = 0
    lost: str = ""


class Workers(Protocol):
    """A place where work is carried out. It is a context manager: what runs when it is left is stopped."""

    def __enter__(self) -> Workers: ...

    def __exit__(self, *of_error: object) -> None: ...

    def room(self, needs: Needs) -> int:
        """How many more pieces of work of these needs may be started now."""

    def sharing(self, needs: Needs) -> int:
        """How many pieces of work may run on one machine at the same time."""

    def start(self, work: Work) -> None:
        """Start a piece of work; only where there is room."""

    def wait(self) -> list[Ended]:
        """What has ended since the last call. Waits for a tenth of a second at most where nothing has."""
