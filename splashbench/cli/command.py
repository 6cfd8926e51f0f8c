"""How commands join the parser, and the one line for a name that is old or unknown.

Every command is added by `add_command`, every noun with actions by `add_group`: both demand a summary, a description
and an epilog with examples, and both keep the epilog's lines as they are written.
"""

from __future__ import annotations

import argparse
import difflib
from collections.abc import Callable, Sequence

from splashbench.cli.output import add_json

Handler = Callable[[argparse.Namespace], int]

#: Names up to version 0.1, with what to type instead.
RENAMED: dict[tuple[str, ...], str] = {
    ("run", "external"): "splashbench run-external SCENE OUT --name ... --format ... --command ...",
    ("scene", "place"): "splashbench scene place-container SCENE MESH",
    ("scene", "container"): "splashbench scene reconstruct-container SCENE",
    ("study", "ablate"): "splashbench study run SPEC OUT",
}


def add_command(
    subparsers: argparse._SubParsersAction,
    name: str,
    handler: Handler,
    *,
    summary: str,
    description: str,
    epilog: str,
) -> argparse.ArgumentParser:
    """Add a command that runs `handler`, with `--json`; its own arguments are the caller's to add.

    Args:
        summary: the command's line in the list of its siblings.
        epilog: examples first, each line `splashbench ...`; then what else a user must know.
    """
    parser = _add_parser(subparsers, name, summary, description, epilog)
    add_json(parser)
    parser.set_defaults(handler=handler, usage_error=parser.error)
    return parser


def add_group(
    subparsers: argparse._SubParsersAction, name: str, *, summary: str, description: str, epilog: str
) -> argparse._SubParsersAction:
    """Add a noun with actions of its own, such as `scene`; returns what the actions are added to."""
    parser = _add_parser(subparsers, name, summary, description, epilog)
    return parser.add_subparsers(dest="action", metavar="ACTION", title="actions", required=True)


def _add_parser(
    subparsers: argparse._SubParsersAction, name: str, summary: str, description: str, epilog: str
) -> argparse.ArgumentParser:
    return subparsers.add_parser(
        name,
        help=summary,
        description=description,
        epilog=epilog,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )


def subcommands(parser: argparse.ArgumentParser) -> dict[str, argparse.ArgumentParser]:
    """Name -> parser of the commands right below `parser`; empty for a command without actions."""
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            return dict(action.choices)
    return {}


def unknown_command(parser: argparse.ArgumentParser, words: Sequence[str]) -> str | None:
    """One line for the first of `words` that names no command, or None where all do.

    argparse would list every choice instead; this names the new name of an old command, or the nearest one.
    """
    path: list[str] = []
    for word in words:
        if (renamed := RENAMED.get((*path, word))) is not None:
            return f"`{' '.join(['splashbench', *path, word])}` has a new name: {renamed}"
        choices = subcommands(parser)
        if not choices or word.startswith("-"):
            return None
        if word not in choices:
            near = difflib.get_close_matches(word, choices, n=1)
            hint = f"did you mean `{near[0]}`?" if near else f"there are {', '.join(choices)}"
            return f"`{' '.join(['splashbench', *path])}` has no command {word!r}; {hint}"
        parser = choices[word]
        path.append(word)
    return None
