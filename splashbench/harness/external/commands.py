"""Commands of an external code as a user types them, with placeholders such as {scene} for what the harness knows."""

from __future__ import annotations

import os
import re
import shlex
import shutil
import sys
from collections.abc import Mapping
from pathlib import Path

from splashbench.child import child_command
from splashbench.errors import SplashbenchError

#: What may stand in a command, and what it means.
PLACEHOLDERS = {
    "scene": "folder of the exported scene",
    "out": "folder for the model, made and empty",
    "into": "folder for renders/, alpha/ and particles.npz",
    "views": "test_views.json, which lists the views to render",
    "seed": "the seed",
    "device": "the device",
    "frames": "number of timesteps",
    "seconds": "from the first to the last of them",
    "progress": 'file for lines "FRACTION MESSAGE", which move the bar',
}
# Doubled braces are braces; a shell's ${name} is its own.
_PLACEHOLDER = re.compile(r"\{\{|\}\}|(?<!\$)\{([a-z_]+)\}")


def _filled(text: str, values: Mapping[str, str]) -> str:
    def fill(match: re.Match[str]) -> str:
        if match.group(1) is None:
            return match.group()[0]
        return values[match.group(1)]

    return _PLACEHOLDER.sub(fill, text)


def require_command(option: str, text: str, shell: bool, directory: Path) -> None:
    """Raise SplashbenchError where the command `text`, given as `option`, cannot be run: before any work."""
    unknown = [name for name in _PLACEHOLDER.findall(text) if name and name not in PLACEHOLDERS]
    if unknown:
        placeholders = ", ".join(f"{{{name}}}" for name in PLACEHOLDERS)
        raise SplashbenchError(f"{option}: there is no placeholder {{{unknown[0]}}}; there are {placeholders}")
    try:
        words = shlex.split(text)
    except ValueError as error:
        raise SplashbenchError(f"{option}: {text!r} cannot be split into words ({error}); fix its quotes") from None
    if not words:
        raise SplashbenchError(f"{option} is empty; give the program and its arguments")
    if shell or _PLACEHOLDER.search(words[0]):
        return
    program = str(directory / words[0]) if os.sep in words[0] else words[0]
    if shutil.which(program) is None:
        raise SplashbenchError(f"{option}: {words[0]} is no program that can be run; give its full path")


def command_line(text: str, values: Mapping[str, str], shell: bool, directory: Path) -> list[str]:
    """The arguments that run `text` with `values` in its placeholders, in `directory`, ended with this process.

    Without `shell` a value is one argument or part of one, whatever is in it; with it, values are quoted.
    """
    if shell:
        words = ["/bin/sh", "-c", _filled(text, {name: shlex.quote(value) for name, value in values.items()})]
    else:
        words = [_filled(word, values) for word in shlex.split(text)]
    return child_command(become, directory, *words)


def become(directory: str, *command: str) -> int:
    """Turn this child process into `command` in `directory`, which then ends with the harness as the child would.

    An external program does not ask the kernel to be killed when its parent dies; the child has asked already.
    """
    os.chdir(directory)
    try:
        os.execvp(command[0], command)
    except OSError as error:
        print(f"{command[0]}: {error.strerror or error}", file=sys.stderr)
        return 127
