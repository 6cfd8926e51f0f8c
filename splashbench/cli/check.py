"""`splashbench check SUBMISSION`: list every fault of a submission at once."""

from __future__ import annotations

import argparse
from pathlib import Path

from splashbench.cli.command import add_command
from splashbench.cli.output import report_faults, say

_EPILOG = """\
examples:
  splashbench check submissions/bowl_001/splashsplat --scene scenes/bowl_001
  splashbench check submissions/bowl_001/from_elsewhere --scene scenes/bowl_001 --pixels

Images are held against their checksums. Only one that was forged on purpose needs --pixels to be found.
"""


def register(subparsers: argparse._SubParsersAction) -> None:
    """Add the command to the parser."""
    parser = add_command(
        subparsers,
        "check",
        run,
        summary="list every fault of a submission",
        description="List every fault of SUBMISSION: changed or missing files, wrong sizes or formats, missing frames.",
        epilog=_EPILOG,
    )
    parser.add_argument("submission", type=Path, metavar="SUBMISSION", help="folder of the submission")
    parser.add_argument("--scene", type=Path, help="the scene it was made for: sizes and frames are checked against it")
    parser.add_argument("--pixels", action="store_true", help="also unpack every image, as scoring does; slower")


def run(arguments: argparse.Namespace) -> int:
    """Handle `splashbench check`."""
    from splashbench.errors import one_line
    from splashbench.scene import Scene
    from splashbench.submission import Status, Submission, check_submission

    scene = Scene.open(arguments.scene) if arguments.scene else None
    faults = check_submission(arguments.submission, scene, arguments.pixels)
    if not faults:
        # Complete, but nothing to score: a person who checks wants to know.
        record = Submission.open(arguments.submission, verify=False).record
        if record.status != Status.OK:
            say(f"{arguments.submission}: the run ended with status {record.status.value}: {one_line(record.reason)}")
    return report_faults("submission", arguments.submission, faults, arguments.json)
