"""What pictures of the documents have in common: scenes and fits in build/pictures, and how figures are stored."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image

from splashbench.scene import Scene
from splashbench.submission import Submission

ROOT = Path(__file__).parents[2]
IMAGES = ROOT / "docs" / "images"
WORK = ROOT / "build" / "pictures"
SCENE = WORK / "scene"
POUR = ("synth", "scene", "opaque_bowl")
METHODS = {"splashsplat": "SplashSplat (this project)", "scaffold_4d": "4D-Scaffold-GS (best baseline)"}
SMALL = ("--size", "240x160", "--times-alone")
VIEW, FRAME = "6", 8
ORANGE, BLUE = "#E69F00", "#0072B2"


def made(folder: Path, *command: str) -> Path:
    """`folder`, made by a splashbench command unless it is there."""
    if not folder.exists():
        subprocess.run([sys.executable, "-m", "splashbench", *command], check=True)
    return folder


def fits() -> tuple[Scene, dict[str, Submission]]:
    """The synthetic scene, and the methods of METHODS on it, by their presets `quick`."""
    made(SCENE, *POUR, str(SCENE), "--size", "480x320", "--timesteps", "12")
    submissions = {}
    for name in METHODS:
        out = WORK / "submissions" / name
        submissions[name] = Submission.open(made(out, "run", name, str(SCENE), str(out), "--preset", "quick"))
    return Scene.open(SCENE), submissions


def fits_told_nothing() -> tuple[Scene, dict[str, Submission]]:
    """The same pour, whose scene tells the times alone; splashsplat by `best`, and the rival at full size."""
    folder = WORK / "told_nothing"
    size = ["--size", "480x320", "--timesteps", "12", "--times-alone"]
    scene = made(folder / "scene", *POUR, str(folder / "scene"), *size)
    settings = {"splashsplat": ["--preset", "best"], "scaffold_4d": ["--preset", "quick", "--set", "longest_side=480"]}
    submissions = {}
    for name in METHODS:
        out = folder / name
        submissions[name] = Submission.open(made(out, "run", name, str(scene), str(out), *settings[name]))
    return Scene.open(scene), submissions


def store(figure: Figure, name: str, dpi: int = 150, colours: int = 256) -> Path:
    """Write the figure as a PNG without margins."""
    path = IMAGES / name
    figure.savefig(path, dpi=dpi, facecolor="white", bbox_inches="tight", pad_inches=0.05, metadata={"Software": None})
    return shrink(path, path, colours=colours)


def shrink(source: Path, path: Path, width: int | None = None, colours: int = 256) -> Path:
    """Write the picture `source` with at most `colours` colours (0: all), and scaled down to `width` pixels."""
    image = Image.open(source).convert("RGB")
    if width and width < image.width:
        image = image.resize((width, round(image.height * width / image.width)), Image.Resampling.LANCZOS)
    small = image.quantize(colours, dither=Image.Dither.NONE) if colours else image
    small.save(path, optimize=True)
    return path


def bare(axes: Axes, title: str = "") -> Axes:
    """Axes for an image: no ticks, no frame."""
    axes.set_xticks([])
    axes.set_yticks([])
    for spine in axes.spines.values():
        spine.set_visible(False)
    axes.set_title(title, fontsize=10)
    return axes


def window(mask: NDArray[np.bool_], margin: int = 14) -> tuple[slice, slice]:
    """Rows and columns around the pixels of `mask`."""
    rows, columns = (np.flatnonzero(mask.any(axis=axis)) for axis in (1, 0))
    return (
        slice(max(0, rows[0] - margin), rows[-1] + margin + 1),
        slice(max(0, columns[0] - margin), columns[-1] + margin + 1),
    )
