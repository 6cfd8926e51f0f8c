"""The command line `splashbench`: a thin shell around the library, one module per command.

Command modules import what they need inside their handlers, so that `--help` answers at once. Exit status:

    0    done
    1    failed; one line says what is wrong and what to do
    2    wrong usage
    130  interrupted
    141  the reader of its output went away
    143  terminated
"""

from __future__ import annotations

import argparse
import importlib
import os
import signal
import sys
import warnings
from contextlib import suppress

from splashbench.cli.command import unknown_command
from splashbench.errors import SplashbenchError, one_line
from splashbench.processes import Terminated, terminable
from splashbench.version import __version__

#: In the order of the work: session, scene, method, submission, result.
COMMANDS = (
    *("demo", "synth", "prepare", "masks", "scene", "methods", "run", "run-external", "check", "explain"),
    *("view", "video", "restyle", "export", "download", "score", "leaderboard", "study", "benchmark"),
)

_EPILOG = """\
the usual order:
  splashbench demo OUT                              all of the following, on a synthetic pour
  splashbench synth session SESSION                 a synthetic recording with exact ground truth
  splashbench prepare SESSION SCENE                 calibrate, synchronise, mask, crop
  splashbench run splashsplat SCENE SUBMISSION      reconstruct
  splashbench explain SUBMISSION                    why the fit is as large and as slow as it is
  splashbench download lpips-weights                once: the network weights of the metric LPIPS
  splashbench view SUBMISSION --scene SCENE         look at it in a browser, at any speed
  splashbench video SUBMISSION OUT.mp4              look at it, from anywhere and at any speed
  splashbench export SUBMISSION OUT --format mesh   for Blender, SuperSplat, numpy
  splashbench score SUBMISSION --scene SCENE --out RESULTS
  splashbench leaderboard RESULTS OUT               CSV, table and charts
  splashbench study run ablation OUT --scenes SCENE     many runs in one table
  splashbench download scenes REAL                  the paper's 20 real scenes
  splashbench benchmark run OUT --scenes REAL       methods on all of them, with an estimate before
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
        importlib.import_module(f"splashbench.cli.{name.replace('-', '_')}").register(subparsers)
    return parser


def run_within(words: list[str]) -> int:
    """Run another command within this one; returns its exit status."""
    parsed = build_parser().parse_args(words)
    return int(parsed.handler(parsed))


def main(argv: list[str] | None = None) -> int:
    """Run the command line; returns the exit status."""
    # Idle OpenMP threads that spin steal cores from the renderer's own; the user's choice wins.
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    # Started with closed streams, as some schedulers do, Python has none.
    sys.stdout = sys.stdout or open(os.devnull, "w")  # noqa: SIM115, PTH123
    sys.stderr = sys.stderr or open(os.devnull, "w")  # noqa: SIM115, PTH123
    # Letters that the charts' font lacks are drawn as boxes; a warning on the terminal helps nobody.
    warnings.filterwarnings("ignore", message=r"Glyph \d+ .* missing from")
    try:
        with terminable():
            parser = build_parser()
            fault = unknown_command(parser, sys.argv[1:] if argv is None else argv)
            if fault:
                return _fail(fault, status=2)
            arguments = parser.parse_args(argv)
            status = int(arguments.handler(arguments))
            _flush()
            return status
    except SplashbenchError as error:
        return _fail(str(error))
    except KeyboardInterrupt as error:
        with suppress(BrokenPipeError):
            print("\ninterrupted; nothing half-written was left", file=sys.stderr)
        return 128 + (error.signum if isinstance(error, Terminated) else signal.SIGINT)
    except BrokenPipeError:
        # The reader of our output went away (`| head`); a shell gives any tool this status then.
        _drop_output()
        return 141
    except MemoryError as error:
        return _fail(f"out of memory ({error}); close other programs, or work on smaller images or fewer at once")
    except OSError as error:
        from splashbench.files import as_asked

        name = "standard output or a file" if error.filename is None else as_asked(os.fsdecode(error.filename))
        return _fail(f"{name}: {error.strerror or error}; check the path, its permissions and the space on the disk")


def _flush() -> None:
    """Write what standard output still holds; a failure names it."""
    try:
        sys.stdout.flush()
    except BrokenPipeError:
        raise
    except OSError as error:
        _drop_output()
        raise OSError(error.errno, error.strerror, "standard output") from None


def _drop_output() -> None:
    """Send what is left in standard output's buffer nowhere; Python would complain again while closing."""
    try:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except (OSError, ValueError):  # no real stream, as in a test
        sys.stdout = open(os.devnull, "w")  # noqa: SIM115, PTH123


def _fail(message: str, status: int = 1) -> int:
    with suppress(BrokenPipeError):
        print(f"error: {one_line(message)}", file=sys.stderr)
    return status


if __name__ == "__main__":
    sys.exit(main())
