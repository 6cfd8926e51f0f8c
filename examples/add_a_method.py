"""A method of your own: one class to fit, one for what was fitted. Any file does: `splashbench run FILE.py:CLASS`."""

import sys
from pathlib import Path

import numpy as np

from splashbench import Camera, Fitted, Method, MethodConfig, Particles, Render, Scene
from splashbench.harness.runner import run_method
from splashbench.score import Result, score_submission
from splashbench.synth.balls import write_balls_scene


class NearestView(Method):
    """Shows the training image whose camera stands nearest. It needs the scene alone, so there is nothing to store."""

    id, title, Config = "nearest_view", "the image of the nearest training camera", MethodConfig

    def fit(self, scene, config, run):
        return NearestImages(scene)

    def load(self, directory, scene):
        return NearestImages(scene)


class NearestImages(Fitted):
    """What was fitted: the training views themselves."""

    def __init__(self, scene) -> None:
        self.scene = scene

    def render(self, camera: Camera, time: float) -> Render:
        distance = {name: np.linalg.norm(view.center - camera.center) for name, view in self.scene.cameras.items()}
        name, t = min(distance, key=distance.get), int(np.abs(self.scene.times - time).argmin())
        return Render(np.float32(self.scene.image(name, t)) / 255, np.float32(self.scene.mask(name, t)))

    def particles(self) -> Particles | None:
        return None

    def save(self, directory: Path) -> None:
        (directory / "model.txt").write_text("nothing to store\n")


def main(out: Path) -> Result:
    """Run the method of this very file on the balls, and score it."""
    if not (out / "balls").exists():
        write_balls_scene(out / "balls", size=(192, 128))
    method = f"{Path(__file__).resolve()}:NearestView"
    submission = run_method(method, out / "balls", out / "nearest_view", timing_frames=0, replace=True)
    if submission.status != "ok":
        raise SystemExit(f"{submission.status.value}: {submission.reason}")
    result = score_submission(Scene.open(out / "balls"), submission)
    print(f"PSNR {result.value('psnr'):.1f} dB, mIoU {result.value('miou'):.3f}")
    return result


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "example_output"))
