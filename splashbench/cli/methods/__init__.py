"""`splashbench methods list|show|test`: which methods there are, what can be set on them, and whether one is sound."""

from __future__ import annotations

import argparse
from typing import Any

from splashbench.cli.methods import conformance as methods_test
from splashbench.cli.output import add_json, emit, table

_EPILOG = """\
examples:
  splashbench methods list
  splashbench methods show splashsplat              presets and settings
  splashbench methods test my_method.py:MyMethod    does it keep the contract?
"""


def register(subparsers: argparse._SubParsersAction) -> None:
    """Add the command to the parser."""
    parser = subparsers.add_parser(
        "methods",
        help="list the methods, show one's settings, test one",
        description="Methods are found through the entry-point group splashbench.methods (CONTRIBUTING.md).",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    actions = parser.add_subparsers(dest="action", metavar="list|show|test", required=True)
    listing = actions.add_parser("list", help="every method installed", description="List every method installed.")
    add_json(listing)
    listing.set_defaults(handler=list_methods)
    show = actions.add_parser("show", help="presets and settings of one", description="Presets and settings of METHOD.")
    show.add_argument("method", help="a name from `splashbench methods list`, or FILE.py:CLASS")
    add_json(show)
    show.set_defaults(handler=show_method)
    methods_test.register(actions)


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
    from splashbench.harness.discovery import EXTERNAL, ORACLE, registered

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
    rows.append(
        {
            "id": EXTERNAL,
            "title": "a code run by its own commands (docs/external_methods.md)",
            "control": False,
            "presets": {},
        }
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
        raise SplashbenchError("an external code's settings are in its commands; see `splashbench run --help`")
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
