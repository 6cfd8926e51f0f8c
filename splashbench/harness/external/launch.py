"""`python -m splashbench.harness.external.launch HARNESS DIRECTORY COMMAND...`: becomes COMMAND.

COMMAND then ends with the harness.

A stranger's program does not ask the kernel to be killed when its parent dies; this asks, and then turns into it.
"""

from __future__ import annotations

import os
import sys

from splashbench.processes import end_with_parent


def main(harness: str, directory: str, *command: str) -> None:
    """Run `command` in `directory`, in place of this process. harness: the process id of the parent."""
    end_with_parent(int(harness))
    os.chdir(directory)
    try:
        os.execvp(command[0], command)
    except OSError as error:
        print(f"{command[0]}: {error.strerror or error}", file=sys.stderr)
        sys.exit(127)


if __name__ == "__main__":
    main(*sys.argv[1:])
