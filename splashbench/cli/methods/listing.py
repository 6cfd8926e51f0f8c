"""`splashbench methods list` and `splashbench methods show`: the methods installed, and the settings of one."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from textwrap import shorten
from typing import Any

from splashbench.cli.arguments import add_method
from splashbench.cli.command import add_command
from splashbench.cli.output import emit, table

# Of the settings' column, and letters of a setting's help; --json has all of it.
_MAX_WIDTH, _MAX_HELP = 44, 110
_LIST_EPILOG = """\
examples:
  splashbench methods list
  splashbench methods list --json
"""

_SHOW_EPILOG = """\
examples:
  splashbench methods show splashsplat
  splashbench methods show my_method.py:MyMethod
"""


def register(actions: argparse._SubParsersAction) -> None:
    """Add the actions to those of `splashbench methods`."""
    add_command(
        actions,
        "list",
        list_methods,
        summary="list every method installed",
        description="List every method installed, with its presets.",
        epilog=_LIST_EPILOG,
    )
    parser = add_command(
        actions,
        "show",
        show_method,
        summary="show the presets and settings of one",
        description="Show the presets of METHOD, and its settings with their defaults.",
        epilog=_SHOW_EPILOG,
    )
    add_method(parser)


def _facts(name: str) -> dict[str, Any]:
    from splashbench.harness.discovery import load_method

    method = load_method(name)
    return {
        "id": method.id,
        "title": method.title,
        "control": method.control,
        "presets": {preset: dict(values) for preset, values in method.Config.presets.items()},
    }


def list_methods(arguments: argparse.Namespace) -> int:
    """Handle `splashbench methods list`."""
    from splashbench.errors import SplashbenchError
    from splashbench.harness.discovery import ORACLE, registered

    rows: list[dict[str, Any]] = []
    for name in registered():
        try:
            rows.append(_facts(name))
        except SplashbenchError as error:
            # A broken third-party method must not hide the others.
            rows.append({"id": name, "title": f"cannot be loaded: {error}", "control": False, "presets": {}})
    rows.append(
        {"id": ORACLE, "title": "the ground truth itself, written by the harness", "control": True, "presets": {}}
    )
    if arguments.json:
        emit({"methods": rows})
        return 0
    lines = [[row["id"], "control" if row["control"] else "method", ", ".join(row["presets"])] for row in rows]
    text = table(["id", "kind", "presets"], lines).splitlines()
    print(text[0] + "  title")
    for line, row in zip(text[1:], rows):
        print(_printable(f"{line.ljust(len(text[0]))}  {row['title']}"))
    return 0


def _printable(line: str) -> str:
    """`line` without control characters: names and titles are those of installed packages."""
    return "".join(letter if letter.isprintable() else "?" for letter in line)


def show_method(arguments: argparse.Namespace) -> int:
    """Handle `splashbench methods show`."""
    from splashbench.errors import SplashbenchError
    from splashbench.harness.discovery import EXTERNAL, ORACLE, load_method
    from splashbench.harness.settings_help import settings_help

    if arguments.method == ORACLE:
        raise SplashbenchError("the oracle is written by the harness and has no settings; just run it")
    if arguments.method == EXTERNAL:
        raise SplashbenchError("an external code's settings are in its commands; see `splashbench run-external --help`")
    method = load_method(arguments.method)
    default = next(iter(method.Config.presets))
    facts = _facts(arguments.method)
    facts["settings"] = method.Config.preset(default).model_dump(mode="json")
    facts["help"] = settings_help(method.Config)
    facts["budgets"] = list(method.budgets)
    facts["capacity"] = {name: list(values) for name, values in method.Config.capacity.items()}
    if arguments.json:
        emit(facts)
        return 0
    for line in _shown(facts, default):
        print(_printable(line))
    return 0


def _shown(facts: dict[str, Any], default: str) -> Iterator[str]:
    """Presets, budgets and the ladder first, then every setting of the preset `default` with a line of help."""
    yield f"{facts['id']}: {facts['title']}"
    for preset, values in facts["presets"].items():
        yield f"  preset {preset}: {values or 'as below'}"
    options = {"seconds": "--budget-seconds", "storage_bytes": "--budget-mb", "memory_bytes": "--budget-memory"}
    if facts["budgets"]:
        kept = ", ".join(options.get(name, name) for name in facts["budgets"])
        yield f"  keeps to budgets: {kept}"
    if facts["capacity"]:
        yield "  ladder of budgets, from the smallest model to the largest (splashbench study capacity):"
        for name, values in facts["capacity"].items():
            yield f"    {name}: {', '.join(map(str, values))}"
    yield f"  settings of preset {default} (change one with --set KEY=VALUE):"
    lines = {name: f"{name} = {value}" for name, value in facts["settings"].items()}
    width = min(max(map(len, lines.values()), default=0), _MAX_WIDTH)
    for name, line in lines.items():
        said = shorten(facts["help"].get(name, ""), _MAX_HELP, placeholder=" ...")
        yield f"    {line.ljust(width)}  {said}".rstrip()
