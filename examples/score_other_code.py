"""Score images that another code made: write them as a submission, check it, score it."""

import sys
from pathlib import Path

import numpy as np

from splashbench.files import atomic_directory
from splashbench.scene import Scene
from splashbench.score import Result, score_submission
from splashbench.submission import Identity, Record, Submission, check_submission, seal, to_8bit, write_view
from splashbench.synth.balls import write_balls_scene


def other_code(scene: Scene, camera: str, t: int) -> tuple[np.ndarray, np.ndarray]:
    """What your code gives for a test view: picture [H, W, 3] and opacity of the liquid [H, W], both in [0, 1].

    Here it is the truth with noise, so that something is there to be scored.
    """
    noise = np.random.default_rng(t).normal(0, 0.05, scene.image(camera, t).shape)
    return scene.image(camera, t) / 255 + noise, scene.mask(camera, t).astype(float)


def main(out: Path) -> Result:
    """Write the submission into `out` and score it."""
    if not (out / "balls").exists():
        write_balls_scene(out / "balls", size=(192, 128))
    scene = Scene.open(out / "balls")

    with atomic_directory(out / "other_code", replace=True, holds="submission.toml") as folder:
        for camera in scene.test:
            for t in range(scene.n_frames):
                rgb, alpha = other_code(scene, camera, t)
                write_view(folder, camera, t, to_8bit(rgb), to_8bit(alpha))
        identity = Identity(method="other_code", scene=scene.name, scene_digest=scene.digest)
        seal(folder, identity, Record(fit_seconds=12.3))

    faults = check_submission(out / "other_code", scene)
    if faults:
        raise SystemExit("\n".join(faults))
    result = score_submission(scene, Submission.open(out / "other_code"))
    for name in ("psnr", "ssim", "miou", "lpips"):
        value, reason = result.value(name), result.metrics[name].reason
        print(f"{name:6} {value:.3f}" if value is not None else f"{name:6} none: {reason}")
    print(f"wrote {result.save(out / 'results')}")
    return result


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "example_output"))
