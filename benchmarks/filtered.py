"""What the protocol's filter of mixed methods would leave of splashsplat: submissions to be scored beside theirs.

    python benchmarks/filtered.py SUBMISSION... --scene SCENE --out FOLDER
    splashbench score FOLDER/* --scene SCENE --out RESULTS

Methods in which background and liquid are one set of Gaussians have their liquid picked out by the silhouettes of all
training views (docs/protocol.md, "Mixed methods"), which loses what some views do not see. splashsplat knows its liquid
and loses nothing, so that figures marked with a dagger compare a method with a filter against one without. Here
splashsplat gets the same: its opacity is drawn again of the Gaussians that pass, each where it is at the render's time;
the scorer filters its particles; its signed distance is left out, so that volume is taken from particles, as theirs
is. Pictures stay. SUBMISSION has to have its model (SUBMISSION/model); the copies bear the name splashsplat_filtered.
The scene's cameras have to share one clock: else theirs are held against every silhouette at its own camera's time.
"""

from __future__ import annotations

import argparse
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from splashbench.errors import SplashbenchError
from splashbench.files import atomic_directory
from splashbench.observe.consistency import silhouette_consistent
from splashbench.progress import track
from splashbench.scene import Camera, Scene, TrainingScene
from splashbench.score.protocol import require_complete
from splashbench.submission import IDENTITY, Submission, seal, to_8bit, write_view
from splashbench_methods.splashsplat.appearance.compositing import composite
from splashbench_methods.splashsplat.method import FittedSplashSplat, SplashSplat


@torch.no_grad()
def filtered_opacity(
    fitted: FittedSplashSplat, scene: TrainingScene, camera: Camera, t: int, seconds: float
) -> np.ndarray:
    """[H, W] in [0, 1]: of the Gaussians that the silhouettes of timestep `t` allow, as `camera` sees them."""
    nothing = np.zeros((camera.height, camera.width), np.float32)
    children = fitted.children(camera, seconds)
    if children is None:
        return nothing
    allowed = silhouette_consistent(children.means.reshape(-1, 3).numpy(), scene, t).reshape(children.opacities.shape)
    kept = replace(children, opacities=children.opacities * torch.from_numpy(allowed))
    _, alpha = composite(kept, camera, torch.zeros((camera.height, camera.width, 3)))
    return alpha.clamp(0, 1).numpy()


def opened(source: Path, scene: Scene) -> Submission:
    """The submission `source`, which has to be one of splashsplat on `scene`, with its model."""
    submission = Submission.open(source)
    if submission.identity.method != SplashSplat.id:
        raise SplashbenchError(f"{source} is of {submission.identity.method}; give submissions of {SplashSplat.id}")
    require_complete(scene, submission)
    if not (source / "model").is_dir():
        raise SplashbenchError(f"{source} has no model; run it again without --no-model")
    return submission


def write_filtered(submission: Submission, scene: Scene, out: Path, replace_old: bool) -> None:
    """Write `submission` as the filter leaves it, at `out`."""
    source, training = submission.directory, scene.training()
    fitted = SplashSplat().load(source / "model", training)
    with atomic_directory(out, replace=replace_old, holds=IDENTITY, inputs=[source]) as staging:
        for name in scene.test:
            for t in track(range(scene.n_frames), f"filtering {source.name}, view {name}"):
                seconds = float(scene.camera_times[name][t])
                alpha = filtered_opacity(fitted, training, scene.cameras[name], t, seconds)
                write_view(staging, name, t, submission.rendering(name, t), to_8bit(alpha))
        if (source / "particles.npz").is_file():
            shutil.copy2(source / "particles.npz", staging)
        identity = submission.identity.model_copy(update={"method": f"{SplashSplat.id}_filtered", "mixed": True})
        seal(staging, identity, submission.record)


def main() -> int:
    """Write a filtered copy of every submission; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("submissions", nargs="+", type=Path)
    parser.add_argument("--scene", required=True, type=Path)
    parser.add_argument("--out", required=True, type=Path, help="folder for the copies, under the same names")
    parser.add_argument("--replace", action="store_true", help="replace earlier copies")
    options = parser.parse_args()
    try:
        scene = Scene.open(options.scene)
        if any(not np.array_equal(times, scene.times) for times in scene.camera_times.values()):
            raise SplashbenchError(f"{scene.directory}: cameras have times of their own; give a scene with one clock")
        names = [path.resolve().name for path in options.submissions]
        if len(set(names)) < len(names):
            raise SplashbenchError("two submissions have the same name, and so would their copies; give one at a time")
        submissions = [opened(path, scene) for path in options.submissions]
        for name, submission in zip(names, submissions):
            write_filtered(submission, scene, options.out / name, options.replace)
    except SplashbenchError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
