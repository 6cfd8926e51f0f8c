"""`splashbench methods ACTION`: which methods there are, what can be set on them, and whether one is sound."""

from __future__ import annotations

import argparse

from splashbench.cli.command import add_group
from splashbench.cli.methods import conformance, listing

_EPILOG = """\
examples:
  splashbench methods list
  splashbench methods show splashsplat              presets and settings
  splashbench methods test my_method.py:MyMethod    does it keep the contract?
"""


def register(subparsers: argparse._SubParsersAction) -> None:
    """Add the command to the parser."""
    actions = add_group(
        subparsers,
        "methods",
        summary="list the methods, show one's settings, test one",
        description="Methods are found through the entry-point group splashbench.methods (CONTRIBUTING.md).",
        epilog=_EPILOG,
    )
    for module in (listing, conformance):
        module.register(actions)
