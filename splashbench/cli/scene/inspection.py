"""`splashbench scene check` and `splashbench scene info`: list a scene's faults, print what is known of it."""

from __future__ import annotations

import argparse
import json

from splashbench.cli.arguments import add_scene
from splashbench.cli.command import add_command
from splashbench.cli.output import emit, report_faults
from splashbench.errors import one_line

_CHECK_EPILOG = """\
example:
  splashbench scene check scenes/bowl_001

Every file is read. Exit status 1 where there is a fault.
"""

_INFO_EPILOG = """\
examples:
  splashbench scene info scenes/bowl_001
  splashbench scene info scenes/bowl_001 --json
"""


def register(actions: argparse._SubParsersAction) -> None:
    """Add the actions to those of `splashbench scene`."""
    add_scene(
        add_command(
            actions,
            "check",
            check,
            summary="read every file and list every fault",
            description="Read every file of SCENE and list every fault.",
            epilog=_CHECK_EPILOG,
        )
    )
    add_scene(
        add_command(
            actions,
            "info",
            info,
            summary="print cameras, sizes, times, what is known and unknown",
            description="Print the cameras, sizes and times of SCENE, and what is known and unknown of it.",
            epilog=_INFO_EPILOG,
        )
    )


def check(arguments: argparse.Namespace) -> int:
    """Handle `splashbench scene check`."""
    from splashbench.scene.inspection import check_scene

    return report_faults("scene", arguments.scene, check_scene(arguments.scene), arguments.json)


def info(arguments: argparse.Namespace) -> int:
    """Handle `splashbench scene info`."""
    from splashbench.scene import Scene
    from splashbench.scene.inspection import describe_scene

    facts = describe_scene(Scene.open(arguments.scene))
    if arguments.json:
        emit(facts)
    else:
        for key, value in facts.items():
            print(f"{key:18} {one_line(value) if isinstance(value, str) else json.dumps(value)}")
    return 0
