"""Compare two methods on one scene: run both, score both against the same reference, draw the leaderboard."""

import shutil
import sys
from pathlib import Path

from splashbench.harness.runner import run_method
from splashbench.report.charts import speed_accuracy_chart
from splashbench.report.leaderboard import write_leaderboard
from splashbench.report.results import load_results
from splashbench.report.table import leaderboard_table
from splashbench.scene import Scene
from splashbench.score import score_submission, shared_fields
from splashbench.synth.balls import write_balls_scene

METHODS = ("hull_points", "nearest_camera")


def main(out: Path, methods: tuple[str, ...] = METHODS) -> list[Path]:
    """Write the leaderboard of `methods` into `out`; returns its files."""
    if not (out / "balls").exists():
        write_balls_scene(out / "balls", size=(192, 128))
    scene = Scene.open(out / "balls")

    # The control `nothing` is the background without liquid: `dpsnr_bg` is what a method adds to it.
    submissions = {
        name: run_method(
            name, scene.directory, out / "runs" / name, preset=preset, timing_frames=0, overrides=settings, replace=True
        )
        for name, preset, settings in [("nothing", "quick", {"iterations": 50}), *((m, None, {}) for m in methods)]
    }
    # Results of an earlier run of this script would count as a second run of the same seed.
    results = out / "compared"
    shutil.rmtree(results, ignore_errors=True)
    # Signed distances from the training masks, computed once for all.
    fields = shared_fields(scene)
    for submission in submissions.values():
        score_submission(scene, submission, submissions["nothing"], fields=fields).save(results)

    sources = load_results(results)
    table = leaderboard_table(sources)
    print(table[["method", "psnr", "dpsnr_bg", "miou"]])
    (out / "leaderboard").mkdir(exist_ok=True)
    files = write_leaderboard(table, sources, out / "leaderboard")
    files += speed_accuracy_chart(sources, out / "leaderboard")
    print("wrote", *files)
    return files


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "example_output"))
