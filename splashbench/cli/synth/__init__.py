"""`splashbench synth ACTION`: synthetic sessions and scenes with exact ground truth, and preparations checked by it."""

from __future__ import annotations

import argparse

from splashbench.cli.command import add_group
from splashbench.cli.synth import scene, session, verification

_EPILOG = """\
examples:
  splashbench synth session sessions/synthetic
  splashbench prepare sessions/synthetic scenes/synthetic
  splashbench synth verify sessions/synthetic scenes/synthetic
"""


def register(subparsers: argparse._SubParsersAction) -> None:
    """Add the command to the parser."""
    actions = add_group(
        subparsers,
        "synth",
        summary="make synthetic recordings and scenes with exact ground truth",
        description="Make a synthetic recording or scene of which everything is known, or verify a preparation by it.",
        epilog=_EPILOG,
    )
    for module in (session, scene, verification):
        module.register(actions)
