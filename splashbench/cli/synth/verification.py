"""`splashbench synth verify`: what `prepare` made of a synthetic session, compared with its truth."""

from __future__ import annotations

import argparse
from pathlib import Path

from splashbench.cli.arguments import add_replace
from splashbench.cli.command import add_command
from splashbench.cli.output import emit, say, table
from splashbench.errors import SplashbenchError

_EPILOG = """\
example:
  splashbench synth verify sessions/synthetic scenes/synthetic --json

Also writes SCENE/truth/particles.npz, the true particles in the scene's own coordinates and times, from which
`splashbench score` measures a method's geometry and motion. The scene's digest does not change by it.
"""


def register(actions: argparse._SubParsersAction) -> None:
    """Add the action to those of `splashbench synth`."""
    parser = add_command(
        actions,
        "verify",
        verify,
        summary="compare a prepared scene with its session's truth",
        description="Compare the scene that `splashbench prepare` made from a synthetic session with its truth.",
        epilog=_EPILOG,
    )
    parser.add_argument("session", type=Path, metavar="SESSION", help="folder made by `splashbench synth session`")
    parser.add_argument("scene", type=Path, metavar="SCENE", help="folder made from it by `splashbench prepare`")
    parser.add_argument("--out", type=Path, metavar="FILE", help="also write the figures to this JSON file")
    add_replace(parser, "FILE")


def verify(arguments: argparse.Namespace) -> int:
    """Handle `splashbench synth verify`."""
    from splashbench.files import write_model
    from splashbench.synth.recording.verification import verify_scene

    if arguments.out and arguments.out.exists() and not arguments.replace:
        raise SplashbenchError(f"{arguments.out} exists already; give another place, or --replace to replace it")
    verification = verify_scene(arguments.session, arguments.scene)
    if arguments.out:
        write_model(arguments.out, verification)
    if arguments.json:
        emit(verification.model_dump())
    rows = [
        [
            name,
            f"{errors.sync_error_ms:+.3f}",
            f"{errors.focal_error_percent:+.3f}",
            f"{errors.rotation_error_deg:.3f}",
            f"{errors.position_error_mm:.2f}",
            "-" if errors.mask_iou is None else f"{errors.mask_iou:.3f}",
        ]
        for name, errors in verification.cameras.items()
    ]
    say(table(["camera", "sync ms", "focal %", "rotation deg", "position mm", "mask IoU"], rows))
    scale = "unknown" if verification.scale_error_percent is None else f"{verification.scale_error_percent:+.3f} %"
    particles = f"{verification.particles_attached} true particles written to {verification.scene}/truth"
    say(f"error of the metre: {scale}; {particles}")
    return 0
