"""Fit a method to a scene, then film the result with a camera that flies around it while time goes on."""

import sys
from pathlib import Path

import imageio.v3 as imageio
import numpy as np

import splashbench
from splashbench.harness.runner import run_method
from splashbench.scene import Camera, Scene
from splashbench.submission import to_8bit
from splashbench.synth.balls import write_balls_scene


def orbit(camera: Camera, target: np.ndarray, angle: float) -> Camera:
    """`camera` turned by `angle` radians around the vertical axis (y) through `target`."""
    c, s = np.cos(angle), np.sin(angle)
    turn = np.eye(4)
    turn[:3, :3] = [[c, 0, s], [0, 1, 0], [-s, 0, c]]
    turn[:3, 3] = target - turn[:3, :3] @ target
    return Camera("orbit", camera.width, camera.height, camera.K, camera.w2c @ turn)


def main(out: Path, frames: int = 48, size: tuple[int, int] = (192, 128)) -> Path:
    """Write the film into `out`; returns its path."""
    directory = out / f"balls_{size[0]}x{size[1]}"
    if not directory.exists():
        write_balls_scene(directory, size=size)
    scene = Scene.open(directory)
    submission = run_method("hull_points", directory, out / "hull_points", timing_frames=0, replace=True)
    if submission.status != "ok":
        raise SystemExit(f"{submission.status.value}: {submission.reason}")

    model = splashbench.load(submission.directory, scene=directory)
    camera = scene.cameras[scene.train[len(scene.train) // 2]]
    target = submission.particles().at(scene.n_frames // 2).mean(axis=0)
    angles = np.radians(40) * np.sin(np.linspace(0, 2 * np.pi, frames))
    times = np.linspace(scene.times[0], scene.times[-1], frames)
    film = [to_8bit(model.render(orbit(camera, target, a), t).rgb) for a, t in zip(angles, times)]

    imageio.imwrite(out / "fly_around.mp4", np.stack(film), plugin="pyav", codec="libx264", fps=24)
    print(f"look at {out / 'fly_around.mp4'}")
    return out / "fly_around.mp4"


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "example_output"))
