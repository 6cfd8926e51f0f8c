"""Command-line validators, and the options that several commands share."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from pathlib import Path

#: Layouts that `splashbench.scene.export` writes, repeated here so that `--help` need not import it.
EXPORT_FORMATS = ("nerfies", "nerfstudio", "blender", "colmap")
#: Initial points of the liquid in each timestep of an export.
DEFAULT_POINTS = 2000
_MAX_IMAGE_SIDE = 8192


def whole_number(least: int, greatest: int | None = None) -> Callable[[str], int]:
    """A validator of whole numbers from `least` to `greatest` (inclusive; None: no limit)."""
    limits = f"of {least} or more" if greatest is None else f"from {least} to {greatest}"

    def parse(text: str) -> int:
        if not text.isdecimal() or int(text) < least or (greatest is not None and int(text) > greatest):
            raise argparse.ArgumentTypeError(f"{text!r} is not a whole number {limits}")
        return int(text)

    return parse


def positive_number(unit: str, below: float = math.inf) -> Callable[[str], float]:
    """A validator of finite numbers above 0 and below `below`; `unit` is named in its message."""
    limits = "above 0" if below == math.inf else f"between 0 and {below:g}"

    def parse(text: str) -> float:
        try:
            number = float(text)
        except ValueError:
            number = math.nan
        if not 0 < number < below:
            raise argparse.ArgumentTypeError(f"{text!r} is not a number of {unit} {limits}")
        return number

    return parse


def image_size(text: str) -> tuple[int, int]:
    """(width, height) in pixels from a text such as `480x270`."""
    width, separator, height = text.lower().partition("x")
    if not (separator and width.isdecimal() and height.isdecimal()):
        raise argparse.ArgumentTypeError(f"{text!r} is no size; write it like 480x270")
    if not (0 < int(width) <= _MAX_IMAGE_SIDE and 0 < int(height) <= _MAX_IMAGE_SIDE):
        raise argparse.ArgumentTypeError(f"{text!r} is out of range; give 1x1 to {_MAX_IMAGE_SIDE}x{_MAX_IMAGE_SIDE}")
    return int(width), int(height)


def add_scene(parser: argparse._ActionsContainer) -> None:
    """Add the positional SCENE."""
    parser.add_argument("scene", type=Path, metavar="SCENE", help="folder of the scene")


def add_method(parser: argparse._ActionsContainer, also: str = "") -> None:
    """Add the positional METHOD; `also` names what else the command takes for one."""
    parser.add_argument(
        "method", metavar="METHOD", help=f"a name from `splashbench methods list`,{also} or FILE.py:CLASS"
    )


def add_settings(parser: argparse._ActionsContainer, help: str, dest: str = "overrides") -> None:
    """Add `--set KEY=VALUE`, which may be given several times."""
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", dest=dest, help=help)


def add_seed(parser: argparse._ActionsContainer, help: str = "seed of every random choice") -> None:
    """Add `--seed`, 0 by default."""
    parser.add_argument("--seed", type=whole_number(0), default=0, help=f"{help} (default: 0)")


def add_seeds(parser: argparse._ActionsContainer, help: str) -> None:
    """Add `--seeds SEED ...`, empty where it is not given."""
    parser.add_argument(
        "--seeds", nargs="+", action="extend", type=whole_number(0), default=[], metavar="SEED", help=f"seeds {help}"
    )


def add_device(parser: argparse._ActionsContainer, automatic: bool = False) -> None:
    """Add `--device`; automatic: whether a GPU is taken where there is one and the method can use it."""
    default = "a GPU with gsplat where there is one and the method can use it" if automatic else "cpu"
    parser.add_argument(
        "--device",
        default="auto" if automatic else "cpu",
        help=f"cpu, or cuda for methods that can (default: {default})",
    )


def add_timeout(parser: argparse._ActionsContainer, help: str) -> None:
    """Add `--timeout SECONDS`."""
    parser.add_argument("--timeout", type=positive_number("seconds"), metavar="SECONDS", help=help)


def add_replace(parser: argparse._ActionsContainer, output: str = "OUT") -> None:
    """Add `--replace`; `output` names what it replaces."""
    parser.add_argument("--replace", action="store_true", help=f"replace {output} where it exists")


def add_dye(parser: argparse._ActionsContainer, required: bool = False) -> None:
    """Add `--dye`, `--density` and `--light`."""
    known = "amber, brown, green, blue, clear, or a color as '#rrggbb'"
    what = known if required else f"dye the liquid anew: {known}"
    parser.add_argument("--dye", required=required, metavar="DYE", help=what)
    parser.add_argument(
        "--density", type=_density, default=1.0, metavar="D", help="times the dye's own, or `opaque` (default: 1)"
    )
    parser.add_argument(
        "--light",
        type=positive_number("linear light", below=100),
        default=1.0,
        metavar="L",
        help="how bright white would be where the liquid is, in linear light (default: 1)",
    )


def _density(text: str) -> float:
    if text == "opaque":
        return math.inf
    try:
        return positive_number("times")(text)
    except argparse.ArgumentTypeError:
        raise argparse.ArgumentTypeError(f"{text!r} is no density; give a number above 0, or `opaque`") from None


def add_points(parser: argparse._ActionsContainer) -> None:
    """Add `--points`, the number of initial points of the liquid."""
    parser.add_argument(
        "--points",
        type=whole_number(0),
        default=DEFAULT_POINTS,
        metavar="N",
        help="initial points of the liquid in each timestep, from the masks' visual hull "
        f"(default: {DEFAULT_POINTS}; 0 for none)",
    )


def add_container_masks(parser: argparse._ActionsContainer) -> None:
    """Add `--masks SCENE`, the scene that has the masks of the container."""
    parser.add_argument(
        "--masks", type=Path, metavar="SCENE", help="the scene before it was cropped, which has the container masks"
    )


def add_lpips_weights(parser: argparse._ActionsContainer) -> None:
    """Add `--lpips-weights FILE`."""
    parser.add_argument(
        "--lpips-weights",
        type=Path,
        metavar="FILE",
        help=".npz of LPIPS weights (AlexNet, v0.1; default: those that `splashbench download lpips-weights` fetched)",
    )


def add_study_out(parser: argparse._ActionsContainer, noun: str = "study") -> None:
    """Add the positional OUT of a `noun` of many runs."""
    parser.add_argument("out", type=Path, metavar="OUT", help=f"folder of the {noun}; finished runs in it are reused")


def add_methods(parser: argparse._ActionsContainer, help: str, required: bool = False) -> None:
    """Add `--methods METHOD[:PRESET][:KEY=VALUE,...] ...`, empty where it is not given."""
    parser.add_argument(
        "--methods",
        nargs="+",
        action="extend",
        default=[],
        required=required,
        metavar="METHOD[:PRESET][:KEY=VALUE,...]",
        help=f"names of methods, or FILE.py:CLASS{help}",
    )


def add_run_timeout(parser: argparse._ActionsContainer, lost: str) -> None:
    """Add `--timeout MINUTES` of the runs of a study. lost: what becomes of a run that takes longer."""
    parser.add_argument(
        "--timeout",
        type=positive_number("minutes"),
        metavar="MINUTES",
        help=f"for each fit, and again for each rendering; a run that takes longer {lost}",
    )


def add_study_runs(parser: argparse._ActionsContainer, lost: str, first: str) -> None:
    """Add how the runs of a study are made. lost: what a run that takes too long has not; first: which come first."""
    add_run_timeout(parser, lost)
    parser.add_argument(
        "--budget",
        type=positive_number("minutes"),
        metavar="MINUTES",
        help=f"make runs as long as they end within so many minutes, {first}; the same command again goes on "
        "(default: all runs)",
    )
    parser.add_argument("--retry", action="store_true", help="repeat failed runs")
    parser.add_argument(
        "--device",
        choices=("auto", "cpu"),
        default="auto",
        help="auto: a GPU for the methods that can use one, where there is one with gsplat (default: auto)",
    )


def add_run_options(parser: argparse._ActionsContainer, automatic_device: bool = False) -> None:
    """Add what `run` and `run-external` have in common; automatic_device: see `add_device`."""
    add_seed(parser)
    add_device(parser, automatic_device)
    add_timeout(parser, "limit for the fit, and again for the rendering")
    parser.add_argument(
        "--timing-frames",
        type=whole_number(0),
        metavar="N",
        help="frames timed for FPS (default: 100; with fewer, FPS is not scored)",
    )
    parser.add_argument("--exr", action="store_true", help="write the renders also as OpenEXR, for compositing")
    parser.add_argument("--no-model", action="store_true", help="do not keep the fitted model under OUT/model")
    add_replace(parser)
