"""Whether every machine sees the same files: asked before work is given to it.

The driver writes a word into the folder that all have to share. A machine has to read that word, and the driver has to
see the file that the machine writes beside it.
"""

from __future__ import annotations

import uuid
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from splashbench.errors import SplashbenchError
from splashbench.version import __version__

_REMEDY = "put it on a file system that every machine mounts at the same place, or run without --on"


@dataclass(frozen=True)
class Shared:
    """What every machine has to see.

    Attributes:
        folder: an absolute path; where results are written. probe: the name of a file in it that holds `word`.
        inputs: files and folders that are read. package: the folder of this package. version: of this package.
    """

    folder: Path
    probe: str
    word: str
    inputs: tuple[Path, ...]
    package: Path
    version: str = __version__


@contextmanager
def shared(folder: Path, inputs: Sequence[Path]) -> Iterator[Shared]:
    """What machines are asked for, with its file in `folder`, which is gone afterwards."""
    word = uuid.uuid4().hex
    probe = folder / f".shared-{word[:8]}"
    folder.mkdir(parents=True, exist_ok=True)
    probe.write_text(word, encoding="utf-8")
    try:
        yield Shared(folder, probe.name, word, tuple(inputs), Path(__file__).resolve().parents[1])
    finally:
        for path in folder.glob(f"{probe.name}*"):
            path.unlink(missing_ok=True)


def fault_here(asked: Shared, machine: str) -> str:
    """Why this machine, called `machine`, cannot take part: one line with the remedy; empty where it can."""
    if not asked.package.is_dir() or Path(__file__).resolve().parents[1] != asked.package:
        return (
            f"machine {machine} has no splashbench at {asked.package}; install the same environment at the same "
            "place on every machine"
        )
    if asked.version != __version__:
        return f"machine {machine} has splashbench {__version__}, not {asked.version}; install the same one everywhere"
    probe = asked.folder / asked.probe
    try:
        seen = probe.read_text(encoding="utf-8") == asked.word
    except OSError:
        seen = False
    if not seen:
        return f"machine {machine} does not see {asked.folder}; {_REMEDY}"
    try:
        _answer(asked, machine).write_text(asked.word, encoding="utf-8")
    except OSError as error:
        return f"machine {machine} may not write into {asked.folder} ({error.strerror}); {_REMEDY}"
    for path in asked.inputs:
        if not path.exists():
            return f"machine {machine} does not see {path}; {_REMEDY}"
    return ""


def require_answer(asked: Shared, machine: str) -> None:
    """Raise SplashbenchError where what `machine` wrote into the folder is not seen here."""
    if not _answer(asked, machine).is_file():
        raise SplashbenchError(f"what machine {machine} writes into {asked.folder} is not seen here; {_REMEDY}")


def _answer(asked: Shared, machine: str) -> Path:
    return asked.folder / f"{asked.probe}-{''.join(letter for letter in machine if letter.isalnum())}"
