"""Open a scene, print what is known of it, and draw all cameras at one timestep with the liquid's outline."""

import sys
from pathlib import Path

import matplotlib
import numpy as np

from splashbench.scene import Scene
from splashbench.synth.balls import write_balls_scene

matplotlib.use("Agg")
from matplotlib import pyplot


def main(out: Path) -> Path:
    """Draw the scene into `out`; returns the picture."""
    if not (out / "balls").exists():
        write_balls_scene(out / "balls", size=(192, 128))
    scene = Scene.open(out / "balls")

    print(f"{scene.name}: {len(scene.cameras)} cameras, {scene.n_frames} timesteps")
    print(f"training views {', '.join(scene.train)}; test views {', '.join(scene.test)}")
    print(f"times in seconds, from {scene.times_source}: {np.round(scene.times, 3)}")
    print(f"gravity {scene.gravity}, {scene.metres_per_unit} metres in a unit of length")

    t = scene.n_frames // 2
    figure, grid = pyplot.subplots(2, 4, figsize=(10, 3.8), layout="constrained")
    for axes in grid.flat:
        axes.set_axis_off()
    for name, axes in zip(scene.cameras, grid.flat):
        camera, mask = scene.cameras[name], scene.mask(name, t)
        axes.imshow(scene.image(name, t))
        axes.contour(mask, levels=[0.5], colors=["orange"], linewidths=1)
        axes.set_title(f"camera {name}: {100 * mask.mean():.1f} % liquid", fontsize=9)
        # World to pixels: the true particles lie on the balls.
        pixels, _ = camera.project(scene.truth_particles().at(t)[::20])
        axes.plot(*pixels.T, "w.", markersize=1)
    figure.savefig(out / "scene.png", dpi=110)
    print(f"look at {out / 'scene.png'}")
    return out / "scene.png"


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "example_output"))
