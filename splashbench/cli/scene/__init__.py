"""`splashbench scene ACTION`: inspect a scene, export it for other codes, give it a container, correct it."""

from __future__ import annotations

import argparse

from splashbench.cli.command import add_group
from splashbench.cli.scene import export, inspection, place_container, reconstruct_container, self_calibrate

_EPILOG = """\
examples:
  splashbench scene info scenes/bowl_001
  splashbench scene check scenes/bowl_001
  splashbench scene export scenes/bowl_001 NeRF/bowl_001 --format nerfies
  splashbench scene place-container scenes/bowl_001 bowl_001.glb
  splashbench scene reconstruct-container scenes/bowl_001
  splashbench scene self-calibrate scenes/bowl_001 --out corrected/bowl_001
"""


def register(subparsers: argparse._SubParsersAction) -> None:
    """Add the command to the parser."""
    actions = add_group(
        subparsers,
        "scene",
        summary="inspect a scene, export it for other codes, give it a container, correct it",
        description="A scene is a folder in the released layout, with or without scene.json, or one of NeuroFluid's.",
        epilog=_EPILOG,
    )
    for module in (inspection, export, place_container, reconstruct_container, self_calibrate):
        module.register(actions)
