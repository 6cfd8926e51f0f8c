"""Silhouettes without opacity: where pictures differ from the empty scene, against the mask.

    python benchmarks/silhouettes.py SUBMISSION... --scene SCENE --reference NOTHING [--every 1] [--out TABLE.md]

mIoU of the protocol rests on opacity, that of mixed methods on the filter that picks out their liquid
(docs/protocol.md, "Mixed methods"). This looks at colours alone, and so treats all methods alike: liquid is where a
picture differs from the control `nothing` by more than --thresholds grey levels on the mean of the channels, and counts
within --band pixels of the mask, since further off it is haze, which spill_rgb measures. The row "photographs" is what
the true pictures have: liquid may look like what is behind it, and shadows are no liquid. A method whose background is
the control's own, as splashsplat's, differs from it by its liquid alone, which is to its advantage here. Not part of
the protocol: thresholds have no right value.
"""

from __future__ import annotations

import argparse
import sys
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from splashbench.errors import SplashbenchError
from splashbench.files import write_text
from splashbench.progress import track
from splashbench.scene import Scene
from splashbench.submission import Submission

_LEAST_PIXELS = 64


def overlap(
    picture: NDArray[np.uint8], empty: NDArray[np.uint8], mask: NDArray[np.bool_], threshold: float, band: int
) -> float:
    """Intersection over union of `mask` [H, W] and where `picture` [H, W, 3] differs from `empty`, near the mask."""
    differs = np.abs(picture.astype(np.float32) - empty).mean(axis=2) > threshold
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * band + 1, 2 * band + 1))
    near = cv2.dilate(mask.astype(np.uint8), disc) > 0
    return float((mask & differs).sum() / ((mask | differs) & near).sum())


def figures(
    scene: Scene,
    submission: Submission | None,
    empty: Submission,
    thresholds: Sequence[float],
    band: int,
    every: int,
) -> NDArray[np.float64]:
    """mIoU of the opacity (NaN for photographs, `submission` None), and the overlap at each threshold."""
    views = []
    for name in scene.test:
        frames = []
        for t in range(0, scene.n_frames, every):
            mask = scene.mask(name, t)
            if mask.sum() < _LEAST_PIXELS:
                continue
            opaque = np.nan
            if submission is None:
                picture = scene.image(name, t)
            else:
                picture, alpha = submission.rendering(name, t), submission.alpha(name, t) > 0.5
                opaque = (mask & alpha).sum() / (mask | alpha).sum()
            plain = empty.rendering(name, t)
            changes = [overlap(picture, plain, mask, value, band) for value in thresholds]
            frames.append([opaque, *changes])
        if frames:
            views.append(np.mean(frames, axis=0))
    if not views:
        raise SplashbenchError(f"{scene.name}: no test view has a frame with {_LEAST_PIXELS} mask pixels")
    return np.asarray(np.mean(views, axis=0))


def table(
    scene: Scene, submissions: Sequence[Path], empty: Submission, thresholds: Sequence[float], band: int, every: int
) -> str:
    """The figures as a Markdown table, a row a method."""
    rows: defaultdict[str, list[NDArray[np.float64]]] = defaultdict(list)
    rows["photographs"].append(figures(scene, None, empty, thresholds, band, every))
    for path in track(submissions, "comparing pictures"):
        submission = Submission.open(path)
        label = f"{submission.identity.method} (version {submission.identity.method_version})"
        rows[label].append(figures(scene, submission, empty, thresholds, band, every))
    heads = ["method", "runs", "mIoU of opacity", *(f"of change, > {value:g}" for value in thresholds)]
    lines = [f"| {' | '.join(heads)} |", "|---" * len(heads) + "|"]
    for label, found in rows.items():
        cells = ["" if np.isnan(value) else f"{value:.3f}" for value in np.mean(found, axis=0)]
        lines.append(f"| {' | '.join([label, str(len(found)), *cells])} |")
    return "\n".join(lines) + "\n"


def main() -> int:
    """Print the table, and write it to --out; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("submissions", nargs="+", type=Path)
    parser.add_argument("--scene", required=True, type=Path)
    parser.add_argument("--reference", required=True, type=Path, help="a submission of the control `nothing`")
    parser.add_argument("--every", type=int, default=1, help="every so many frames (default 1)")
    parser.add_argument("--thresholds", type=float, nargs="+", default=[15, 25, 40], help="grey levels")
    parser.add_argument("--band", type=int, default=8, help="pixels about the mask that count (default 8)")
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    try:
        scene, empty = Scene.open(options.scene), Submission.open(options.reference)
        text = table(scene, options.submissions, empty, options.thresholds, options.band, options.every)
        if options.out:
            write_text(options.out, text)
    except SplashbenchError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    print(text, end="")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
