"""The command line `splashbench`: a thin shell around the library, one module per command.

Command modules import what they need inside their handlers, so that `--help` answers at once. Exit status: 0 done,
1 failed with one line saying what and what to do, 2 wrong usage.
"""

from __future__ import annotations

import argparse
import importlib
import os
import sys

from splashbench.errors import SplashbenchError
from splashbench.version import __version__

#: In the order of the work: session, scene, method, submission, result.
COMMANDS = ("demo", "synth", "prepare", "scene", "methods", "run", "check", "score", "leaderboard")

_EPILOG = """\
the usual order:
  splashbench demo OUT                              all of the following, on a made-up pour
  splashbench synth session SESSION                 a made-up recording with exact ground truth
  splashbench prepare SESSION SCENE                 calibrate, synchronise, mask, crop
  splashbench run splashsplat SCENE SUBMISSION      reconstruct
  splashbench score SUBMISSION --scene SCENE --out RESULTS
  splashbench leaderboard RESULTS OUT               CSV, table and charts
"""


def build_parser() -> argparse.ArgumentParser:
    """The parser with every command registered; nothing heavy is imported."""
    parser = argparse.ArgumentParser(
        prog="splashbench",
        description="Reconstruct splashing liquids from several cameras, and score reconstructions.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"splashbench {__version__}")
    subparsers = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    for name in COMMANDS:
        importlib.import_module(f"splashbench.cli.{name}").register(subparsers)
    return parser


def main(argv: list[str] | None = None) -> int:
    """Run the command line; returns the exit status."""
    # Idle OpenMP threads that spin steal cores from the renderer's own; the user's choice wins.
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    arguments = build_parser().parse_args(argv)
    try:
        return int(arguments.handler(arguments))
    except SplashbenchError as error:
        return _fail(str(error))
    except KeyboardInterrupt:
        print("\ninterrupted; nothing half-written was left", file=sys.stderr)
        return 130
    except BrokenPipeError:
        # The reader of our output went away (`| head`); Python would complain again while closing.
        sys.stdout = open(os.devnull, "w")  # noqa: SIM115, PTH123
        return 0
    except OSError as error:
        name = error.filename if error.filename is not None else "a file"
        return _fail(f"{name}: {error.strerror or error}; check the path, its permissions and the space on the disk")


def _fail(message: str) -> int:
    print(f"error: {' '.join(message.split())}", file=sys.stderr)
    return 1


if __name__ == "__main__":
    sys.exit(main())
