"""The exception that a user reads: one line that names the file and the remedy.

The command line prints it after `error:` and exits with status 1. Any other exception that escapes is a bug.
"""


def one_line(text: str) -> str:
    """`text` on one line, control characters replaced: names come from strangers and could take over a terminal."""
    return "".join(letter if letter.isprintable() else "?" for letter in " ".join(text.split()))


class SplashbenchError(Exception):
    """A fault that the user can fix. The message is one line: what is wrong with which file, and what to do."""

    def __init__(self, message: str) -> None:
        super().__init__(one_line(str(message)))


class DiskFullError(SplashbenchError):
    """The disk is full. Nothing half-written is left, and no method is to blame."""
