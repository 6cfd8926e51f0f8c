"""What runs with checkpoints have to show on their way, on a part of the frames: a look at large scenes.

    python benchmarks/states.py SUBMISSION... --scene SCENE [--every 5] [--out TABLE.csv]

`splashbench score` takes minutes a state where images have millions of pixels, most of them for LPIPS. This takes PSNR
and mIoU alone, by the protocol's functions, on each K-th frame of the test views: means over frames, then over views.
The last line of a run is its final model. Silhouettes of mixed methods have passed the protocol's filter.
"""

from __future__ import annotations

import argparse
import csv
import sys
from collections.abc import Iterator
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np

from splashbench.errors import SplashbenchError
from splashbench.files import atomic_path
from splashbench.progress import track
from splashbench.scene import Scene
from splashbench.score import PROTOCOL_V1
from splashbench.score.image.fidelity import psnr
from splashbench.score.image.silhouette import iou
from splashbench.score.protocol import require_complete
from splashbench.submission import Submission


def figures(scene: Scene, views: Any, every: int, what: str) -> tuple[float, float]:
    """PSNR in dB, and mIoU, of what `views` show of the test views of `scene`."""
    fidelity: dict[str, list[float]] = {name: [] for name in scene.test}
    overlap: dict[str, list[float]] = {name: [] for name in scene.test}
    for name in scene.test:
        for t in track(range(0, scene.n_frames, every), f"{what}, view {name}"):
            mask = scene.mask(name, t)
            overlap[name].append(iou(views.alpha(name, t), mask, PROTOCOL_V1.opacity_threshold))
            if np.count_nonzero(mask) >= PROTOCOL_V1.min_mask_pixels:
                shown, true = (
                    each.astype(np.float64) / 255 for each in (views.rendering(name, t), scene.image(name, t))
                )
                fidelity[name].append(psnr(shown, true, mask, PROTOCOL_V1.psnr_cap_db))
    if not any(fidelity.values()):
        raise SplashbenchError(
            f"{scene.directory}: each {every}. frame of its test views has too little liquid for PSNR"
        )
    means = [[fmean(values) for values in each.values() if values] for each in (fidelity, overlap)]
    return fmean(means[0]), fmean(means[1])


def rows(scene: Scene, path: Path, every: int) -> Iterator[tuple[str, str, str, str]]:
    """Of the run in `path`: its method, seconds of the fit, PSNR and mIoU of each state."""
    submission = Submission.open(path)
    require_complete(scene, submission)
    states = [(checkpoint.seconds, views) for checkpoint, views in submission.checkpoints()]
    for seconds, views in [*states, (submission.record.fit_seconds, submission)]:
        fidelity, overlap = figures(scene, views, every, f"{path.name} after {seconds:.0f} s")
        yield submission.identity.method, f"{seconds:.1f}", f"{fidelity:.2f}", f"{overlap:.3f}"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("submissions", nargs="+", type=Path, metavar="SUBMISSION")
    parser.add_argument("--scene", type=Path, required=True)
    parser.add_argument("--every", type=int, default=5, metavar="K", help="use each K-th frame (default: 5)")
    parser.add_argument("--out", type=Path, metavar="CSV", help="also write the table here")
    arguments = parser.parse_args()
    if arguments.every < 1:
        parser.error("--every has to be 1 or more")
    scene = Scene.open(arguments.scene)
    table = [("method", "seconds", "psnr", "miou")]
    for path in arguments.submissions:
        for row in rows(scene, path, arguments.every):
            print("  ".join(row), flush=True)
            table.append(row)
    if arguments.out is not None:
        with atomic_path(arguments.out) as temporary, temporary.open("w", encoding="utf-8", newline="") as file:
            csv.writer(file, lineterminator="\n").writerows(table)
    return 0


if __name__ == "__main__":
    try:
        sys.exit(main())
    except SplashbenchError as error:
        sys.exit(f"error: {error}")
