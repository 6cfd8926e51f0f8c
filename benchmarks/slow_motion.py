"""Slow motion: what it costs, and whether a slowed video flickers at the timesteps.

    python benchmarks/slow_motion.py SUBMISSION --scene SCENE [--view NAME] [--slow 8] [--json FILE]
    python benchmarks/slow_motion.py submissions/bowl --scene scenes/bowl --markdown slow_motion.md

Every step between two timesteps is divided into `--slow` frames of the first test view. Three videos of these instants
are compared:

rendered   each frame at its own time, by the method's own interpolation: what `splashbench video --slow` shows
held       the render of the last timestep, as a video of one picture per timestep shows
faded      the renders of both timesteps around, blended by nearness

For each the second difference in time (splashbench/video/flicker.py) at timesteps (`seams`), at the frames `between`,
their ratio, and the mean over all frames, in levels of 255. All are taken over the pixels that the rendered video calls
liquid.

jump       mean difference in levels between a timestep's render and those a thousandth of a step before and after: 0
           where the interpolation meets the timesteps
motion     the same of neighbouring frames, for comparison

`seconds` is the wall time of the rendered video's frames, by one process.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splashbench import Reconstruction, load
from splashbench.errors import SplashbenchError
from splashbench.files import write_json, write_text
from splashbench.harness import hardware
from splashbench.progress import track
from splashbench.video.flicker import SecondDifference, second_difference, subdivided

_VISIBLE = 0.5
# Of a step: how near to a timestep a jump is looked for.
_NEAR = 1e-3
# Largest ratio that is one.
_MOST = 1e4

Frames = NDArray[np.float32]


def measure(reconstruction: Reconstruction, view: str, parts: int) -> dict[str, Any]:
    """The figures of one submission, see above."""
    camera = reconstruction.camera(view)
    times = subdivided(reconstruction.times, parts)
    reconstruction.render(camera, float(times[0]))  # compiles, and loads what is loaded once
    start = time.perf_counter()
    rgb, alpha = _rendered(reconstruction, view, times, "rendered")
    seconds = time.perf_counter() - start
    liquid = alpha >= _VISIBLE
    places = np.arange(len(times)) / parts
    steps = rgb[::parts]
    before = np.minimum(places.astype(int), len(steps) - 2)
    share = (places - before).astype(np.float32)[:, None, None, None]
    videos = {
        "rendered": second_difference(rgb, liquid, parts),
        "held": second_difference(steps[places.astype(int)], liquid, parts),
        "faded": second_difference((1 - share) * steps[before] + share * steps[before + 1], liquid, parts),
    }
    return {
        "submission": str(reconstruction.submission.directory.name),
        "method": f"{reconstruction.name} {reconstruction.submission.identity.preset}",
        "scene": reconstruction.submission.identity.scene,
        "view": view,
        "size": f"{camera.width}x{camera.height}",
        "timesteps": len(reconstruction.times),
        "frames": len(times),
        "seconds": seconds,
        "jump": _jump(reconstruction, view, steps, liquid[::parts]),
        "motion": _difference(rgb[:-1], rgb[1:], liquid[:-1] | liquid[1:]),
        "videos": {name: _figures(values) for name, values in videos.items()},
    }


def _rendered(
    reconstruction: Reconstruction, view: str, times: NDArray[np.float64], what: str
) -> tuple[Frames, Frames]:
    shots = [reconstruction.render(view, float(t)) for t in track(times, what)]
    return np.stack([shot.rgb for shot in shots]), np.stack([shot.alpha for shot in shots])


def _jump(reconstruction: Reconstruction, view: str, steps: Frames, liquid: NDArray[np.bool_]) -> float:
    """Mean difference of timesteps within the recording to what is just before and after them."""
    inner = reconstruction.times[1:-1]
    gaps = np.diff(reconstruction.times)
    sides = (inner - _NEAR * gaps[:-1], inner + _NEAR * gaps[1:])
    return float(
        np.mean(
            [
                _difference(_rendered(reconstruction, view, side, "jumps")[0], steps[1:-1], liquid[1:-1])
                for side in sides
            ]
        )
    )


def _difference(one: Frames, other: Frames, liquid: NDArray[np.bool_]) -> float:
    """Mean absolute difference in levels of 255 over the liquid of each frame, and over frames."""
    values = [255 * np.abs(a[m] - b[m]).mean() for a, b, m in zip(one, other, liquid) if m.any()]
    return float(np.mean(values)) if values else float("nan")


def _figures(values: SecondDifference) -> dict[str, float]:
    return {"seams": values.seams, "between": values.between, "ratio": values.ratio, "mean": values.mean}


def table(results: list[dict[str, Any]]) -> str:
    """The figures as a Markdown table, a row for each submission and video."""
    lines = [
        "| scene | method | frames | seconds | video | seams | between | ratio | mean | jump | motion |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for result in results:
        for name, figures in result["videos"].items():
            first = name == "rendered"
            cells = [
                result["scene"] if first else "",
                result["method"] if first else "",
                str(result["frames"]) if first else "",
                f"{result['seconds']:.0f}" if first else "",
                name,
                *(_shown(figures[key]) for key in ("seams", "between", "ratio", "mean")),
                f"{result['jump']:.3f}" if first else "",
                f"{result['motion']:.2f}" if first else "",
            ]
            lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def _shown(value: float) -> str:
    return f"{value:.2f}" if value < _MOST else "-"  # a ratio to next to nothing


def main() -> int:
    """Measure each submission and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("submissions", nargs="+", type=Path, metavar="SUBMISSION")
    parser.add_argument("--scene", nargs="+", type=Path, metavar="SCENE", help="of each submission, in their order")
    parser.add_argument("--view", help="default: the first test camera")
    parser.add_argument("--slow", type=int, default=8, help="frames for each step between timesteps (default: 8)")
    parser.add_argument("--json", type=Path, metavar="FILE")
    parser.add_argument("--markdown", type=Path, metavar="FILE")
    arguments = parser.parse_args()
    scenes = arguments.scene or [None] * len(arguments.submissions)
    if len(scenes) != len(arguments.submissions) or arguments.slow < 2:
        parser.error("give a scene for each submission, and --slow 2 or more")
    results = []
    try:
        for submission, scene in zip(arguments.submissions, scenes):
            reconstruction = load(submission, scene)
            view = arguments.view or (reconstruction.test or reconstruction.train)[0]
            results.append(measure(reconstruction, view, arguments.slow))
            print(table(results[-1:]), file=sys.stderr, flush=True)
        text = table(results)
        print(text, end="")
        if arguments.markdown:
            write_text(arguments.markdown, text)
        if arguments.json:
            write_json(arguments.json, {"machine": hardware.describe(), "results": results})
    except SplashbenchError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
