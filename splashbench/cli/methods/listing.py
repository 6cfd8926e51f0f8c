"""`splashbench methods list` and `splashbench methods show`: the methods installed, and the settings of one."""

from __future__ import annotations

import argparse
from typing import Any

from splashbench.cli.arguments import add_method
from splashbench.cli.command import add_command
from splashbench.cli.output import emit, table

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
        print(f"{line.ljust(len(text[0]))}  {row['title']}")
    return 0


def show_method(arguments: argparse.Namespace) -> int:
    """Handle `splashbench methods show`."""
    from splashbench.errors import SplashbenchError
    from splashbench.harness.discovery import EXTERNAL, ORACLE, load_method

    if arguments.method == ORACLE:
        raise SplashbenchError("the oracle is written by the harness and has no settings; just run it")
    if arguments.method == EXTERNAL:
        raise SplashbenchError("an external code's settings are in its commands; see `splashbench run-external --help`")
    method = load_method(arguments.method)
    default = next(iter(method.Config.presets))
    facts = _facts(arguments.method)
    facts["settings"] = method.Config.preset(default).model_dump(mode="json")
    if arguments.json:
        emit(facts)
        return 0
    print(f"{facts['id']}: {facts['title']}")
    for preset, values in facts["presets"].items():
        print(f"  preset {preset}: {values or 'as below'}")
    print(f"  settings of preset {default} (change one with --set KEY=VALUE):")
    for key, value in facts["settings"].items():
        print(f"    {key} = {value}")
    return 0
