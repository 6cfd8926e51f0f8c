"""How well submissions fit what they were trained on: PSNR of training and of test views, inside the liquid and whole.

    python benchmarks/training_views.py SUBMISSION... --scene SCENE [--every 5] [--out TABLE.md]

A method that does not fit its training views is broken or was given too little time; one that fits them far better than
the test views has learned them by heart. The submissions keep their models (OUT/model). Not part of the protocol, which
looks at test views alone. "Gained" is what the last quarter of the fit gained in PSNR of whole training images, where
the method says so (model/history.json).
"""

from __future__ import annotations

import argparse
import json
import math
from pathlib import Path

import numpy as np

from splashbench.files import write_text
from splashbench.harness.contract import Fitted
from splashbench.harness.discovery import load_method
from splashbench.progress import track
from splashbench.scene import Scene
from splashbench.submission import Submission

_LEAST_PIXELS = 64


def figures(scene: Scene, fitted: Fitted, names: tuple[str, ...], every: int) -> tuple[float, float]:
    """PSNR in dB over every so many frames of the cameras `names`: inside the mask (mean over frames), and whole."""
    inside, whole = [], []
    for name in names:
        camera = scene.cameras[name]
        for t in range(0, scene.n_frames, every):
            render = np.clip(fitted.render(camera, float(scene.camera_times[name][t])).rgb, 0, 1)
            squared = (render - scene.image(name, t) / 255.0) ** 2
            mask = scene.mask(name, t)
            whole.append(_decibels(float(squared.mean())))
            if mask.sum() >= _LEAST_PIXELS:
                inside.append(_decibels(float(squared[mask].mean())))
    return float(np.mean(inside)) if inside else math.nan, float(np.mean(whole))


def _decibels(squared: float) -> float:
    return -10 * math.log10(max(squared, 1e-10))


def main() -> None:
    """Print the table, and write it to --out."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("submissions", nargs="+", type=Path)
    parser.add_argument("--scene", required=True, type=Path)
    parser.add_argument("--every", type=int, default=5, help="every so many frames (default 5)")
    parser.add_argument("--out", type=Path)
    arguments = parser.parse_args()
    scene = Scene.open(arguments.scene)
    lines = [
        "| method | seed | train, liquid | test, liquid | train, whole | test, whole | gained in the last quarter |",
        "|---|---|---|---|---|---|---|",
    ]
    for path in track(arguments.submissions, "rendering training views"):
        submission = Submission.open(path)
        identity = submission.identity
        fitted = load_method(identity.method).load(path / "model", scene.training())
        train, test = (figures(scene, fitted, names, arguments.every) for names in (scene.train, scene.test))
        history = path / "model" / "history.json"
        gained = json.loads(history.read_text())["gained_in_last_quarter"] if history.is_file() else None
        cells = [identity.method, str(identity.seed)]
        cells += [f"{value:.2f}" for value in (train[0], test[0], train[1], test[1])]
        lines.append(f"| {' | '.join(cells)} | {'' if gained is None else f'{gained:.2f}'} |")
    table = "\n".join(lines) + "\n"
    print(table, end="")
    if arguments.out:
        write_text(arguments.out, table)


if __name__ == "__main__":
    main()
