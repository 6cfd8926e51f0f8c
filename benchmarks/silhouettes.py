"""Silhouettes without opacity: where pictures differ from the empty scene, against the mask.

    python benchmarks/silhouettes.py SUBMISSION... --scene SCENE --reference NOTHING [--every 1] [--out TABLE.md]

mIoU of the protocol rests on opacity, that of mixed methods on the filter that picks out their liquid
(docs/protocol.md, "Mixed methods"). This looks at colours alone: liquid is where a picture differs from the control
`nothing` by more than --thresholds grey levels on the mean of the channels, and counts within --band pixels of the
mask, since further off it is haze, which spill_rgb measures. The row "photographs" is what the true pictures have:
liquid may look like what is behind it, shadows are no liquid, and the control's background is not the true one. What a
method's own background differs from the control's counts as liquid, too. Frames of fewer than 64 mask pixels count for
mIoU alone, as in the protocol. Not part of the protocol: thresholds have no right value.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections import defaultdict
from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from splashbench.errors import SplashbenchError
from splashbench.files import write_text
from splashbench.progress import track
from splashbench.scene import Scene
from splashbench.score import PROTOCOL_V1
from splashbench.score.image.silhouette import iou
from splashbench.score.protocol import require_complete, require_reference
from splashbench.submission import Submission


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
        opaque, changes = [], []
        for t in range(0, scene.n_frames, every):
            mask = scene.mask(name, t)
            if submission is not None:
                opaque.append(iou(submission.alpha(name, t), mask, PROTOCOL_V1.opacity_threshold))
            if mask.sum() >= PROTOCOL_V1.min_mask_pixels:
                picture = scene.image(name, t) if submission is None else submission.rendering(name, t)
                plain = empty.rendering(name, t)
                changes.append([overlap(picture, plain, mask, value, band) for value in thresholds])
        if changes:
            views.append([np.mean(opaque) if opaque else np.nan, *np.mean(changes, axis=0)])
    if not views:
        least = PROTOCOL_V1.min_mask_pixels
        raise SplashbenchError(f"{scene.name}: no test view has a frame with {least} mask pixels")
    return np.asarray(np.mean(views, axis=0))


def table(
    scene: Scene,
    submissions: Sequence[Submission],
    empty: Submission,
    thresholds: Sequence[float],
    band: int,
    every: int,
) -> str:
    """The figures as a Markdown table; a row is the mean over runs of one method, version, preset and settings."""
    rows: defaultdict[tuple[str, ...], list[NDArray[np.float64]]] = defaultdict(list)
    rows[("photographs", "", "", "")].append(figures(scene, None, empty, thresholds, band, every))
    for submission in track(submissions, "comparing pictures"):
        identity = submission.identity
        settings = json.dumps(identity.settings, sort_keys=True)
        key = (identity.method, identity.method_version, identity.preset, settings)
        rows[key].append(figures(scene, submission, empty, thresholds, band, every))
    heads = ["method", "version", "preset", "runs", "mIoU of opacity"]
    heads += [f"of change, > {value:g}" for value in thresholds]
    lines = [f"| {' | '.join(heads)} |", "|---" * len(heads) + "|"]
    for key, found in rows.items():
        cells = ["" if np.isnan(value) else f"{value:.3f}" for value in np.mean(found, axis=0)]
        lines.append(f"| {' | '.join([*key[:3], str(len(found)), *cells])} |")
    return "\n".join(lines) + "\n"


def _at_least(least: int) -> Callable[[str], int]:
    def number(text: str) -> int:
        if int(text) < least:
            raise argparse.ArgumentTypeError(f"{text} is less than {least}")
        return int(text)

    return number


def main() -> int:
    """Print the table, and write it to --out; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("submissions", nargs="+", type=Path)
    parser.add_argument("--scene", required=True, type=Path)
    parser.add_argument("--reference", required=True, type=Path, help="a submission of the control `nothing`")
    parser.add_argument("--every", type=_at_least(1), default=1, help="every so many frames (default 1)")
    parser.add_argument("--thresholds", type=float, nargs="+", default=[15, 25, 40], help="grey levels")
    parser.add_argument("--band", type=_at_least(0), default=8, help="pixels about the mask that count (default 8)")
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    try:
        scene, empty = Scene.open(options.scene), Submission.open(options.reference)
        require_reference(scene, empty)
        submissions = [Submission.open(path) for path in options.submissions]
        for submission in submissions:
            require_complete(scene, submission)
        text = table(scene, submissions, empty, options.thresholds, options.band, options.every)
        print(text, end="")
        if options.out:
            write_text(options.out, text)
    except SplashbenchError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
