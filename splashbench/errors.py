"""The one exception a user is meant to read: a single line naming the file and the remedy.

The command line prints its text after ``error:`` and exits with status 1; anything else that escapes is a bug.
"""


def one_line(text: str) -> str:
    """`text` on one line and without control characters: names come from strangers and could take over a terminal."""
    return "".join(letter if letter.isprintable() else "?" for letter in " ".join(text.split()))


class SplashbenchError(Exception):
    """Something the user can mend. The message is one line: what is wrong with which file, and what to do."""

    def __init__(self, message: str) -> None:
        super().__init__(one_line(str(message)))


class DiskFullError(SplashbenchError):
    """The disk took no more. Nothing half-written is left, and no method is to blame."""
