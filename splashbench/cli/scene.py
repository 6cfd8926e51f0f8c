"""`splashbench scene check|info`: look a scene over, or tell what is in it."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from splashbench.cli.output import add_json, emit, say

_EPILOG = """\
examples:
  splashbench scene info scenes/bowl_001
  splashbench scene check scenes/bowl_001           every file is read; every fault is listed
"""


def register(subparsers: argparse._SubParsersAction) -> None:
    """Add the command to the parser."""
    parser = subparsers.add_parser(
        "scene",
        help="look a scene over",
        description="A scene is a folder in the released layout, with or without scene.json, or one of NeuroFluid's.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    actions = parser.add_subparsers(dest="action", metavar="check|info", required=True)
    for name, help_text, handler in (
        ("check", "read every file and list every fault", check),
        ("info", "cameras, sizes, times, what is known and unknown", info),
    ):
        action = actions.add_parser(
            name,
            help=help_text,
            description=help_text,
            epilog=_EPILOG,
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        action.add_argument("scene", type=Path, help="folder of the scene")
        add_json(action)
        action.set_defaults(handler=handler)


def check(arguments: argparse.Namespace) -> int:
    """Handle `splashbench scene check`."""
    from splashbench.scene.checking import check_scene

    faults = check_scene(arguments.scene)
    if arguments.json:
        emit({"scene": str(arguments.scene), "ok": not faults, "faults": faults})
    for fault in faults:
        say(f"error: {fault}")
    if not faults:
        say(f"{arguments.scene}: no fault found")
    return 1 if faults else 0


def info(arguments: argparse.Namespace) -> int:
    """Handle `splashbench scene info`."""
    from splashbench.scene import Scene
    from splashbench.scene.checking import describe_scene

    facts = describe_scene(Scene.open(arguments.scene))
    if arguments.json:
        emit(facts)
    else:
        for key, value in facts.items():
            print(f"{key:18} {value if isinstance(value, str) else json.dumps(value)}")
    return 0
