"""`make pictures`: every picture of README.md and of the site but for charts, drawn anew into docs/images.

Scenes and fits go into build/pictures; what is there already is kept. `python docs/tools/pictures.py test_view` draws
one of the groups below. Charts of results are drawn by docs/results/charts.py.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import matplotlib
import method_pictures
import numpy as np
from drawing import (
    FRAME,
    IMAGES,
    METHODS,
    ORANGE,
    ROOT,
    SCENE,
    VIEW,
    WORK,
    bare,
    fits,
    fits_told_nothing,
    made,
    shrink,
    store,
    window,
)
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image
from scipy import ndimage

from splashbench.dyes import DYES
from splashbench.errors import SplashbenchError
from splashbench.replay import load
from splashbench.report.contact_sheet import contact_sheet
from splashbench.restyle import filmed_dye, restyled
from splashbench.scene import Scene
from splashbench.study.perturbations import KINDS, Dice, Recording, Step, perturbed
from splashbench.study.perturbations.setup import MissingCameras
from splashbench.study.perturbations.timesteps import FewerTimesteps
from splashbench.study.scenes import recording_of
from splashbench.submission import Submission, to_8bit
from splashbench.video import TRUTH, Comparison, VideoSettings, make_film
from splashbench.video.layers import LAYERS


def main(names: Sequence[str]) -> None:
    """Draw the groups of pictures that `names` lists; all of them by default."""
    matplotlib.rcParams.update({"font.family": "DejaVu Sans", "font.size": 10})
    IMAGES.mkdir(parents=True, exist_ok=True)
    for name in names or GROUPS:
        for path in GROUPS[name]():
            print(f"{path.relative_to(ROOT)}: {path.stat().st_size / 1000:.0f} kB")


def test_view() -> list[Path]:
    """The first picture of README.md: truth, splashsplat, the best baseline, and the liquid's opacity below."""
    scene, submissions = fits_told_nothing()
    mask = scene.mask(VIEW, FRAME)
    crop = window(mask)
    columns = [("truth", scene.image(VIEW, FRAME), mask.astype(np.float32))]
    columns += [(METHODS[n], s.rendering(VIEW, FRAME), s.alpha(VIEW, FRAME)) for n, s in submissions.items()]
    height = (crop[0].stop - crop[0].start) / (crop[1].stop - crop[1].start)
    figure = Figure(figsize=(9, 2 * 2.85 * height + 0.3), layout="constrained")
    grid = figure.subplots(2, len(columns))
    for (title, picture, opacity), (top, bottom) in zip(columns, grid.T):
        bare(top, title).imshow(picture[crop], interpolation="lanczos")
        bare(bottom).imshow(opacity[crop], cmap="gray", vmin=0, vmax=1)
        bottom.contour(mask[crop], levels=[0.5], colors=[ORANGE], linewidths=0.8)
    grid[0, 0].set_ylabel("picture")
    grid[1, 0].set_ylabel("opacity of the liquid")
    return [store(figure, "test_view.png", 110)]


def perturbations() -> list[Path]:
    """A training view with each kind of perturbation at its fourth severity; masks as outlines."""
    folder = WORK / "opaque_bowl_recorded"
    made(folder, "synth", "scene", "opaque_bowl", str(folder), "--size", "360x240", "--timesteps", "24")
    scene = Scene.open(folder)
    given = recording_of(scene)
    figure = Figure(figsize=(15, 6.8), layout="constrained")
    panels = iter(figure.subplots(4, 8).flat)
    # What is missing or stated wrongly is in no photograph.
    unseen = MissingCameras.__module__, FewerTimesteps.__module__
    for kind in (None, *(kind for kind in KINDS if kind.__module__ not in unseen)):
        worse = given if kind is None else _worse(given, kind, scene.name)
        title = "as it is" if kind is None else kind.named().replace("_", " ")
        name, t = _most_changed(given, worse)
        image = worse.image(name, t).copy()
        outline = ndimage.binary_dilation(worse.mask(name, t)) ^ worse.mask(name, t)
        image[outline] = (230, 159, 0)
        bare(next(panels), title).imshow(image[20:190, 80:290])
    for left in panels:
        left.axis("off")
    return [store(figure, "perturbations.png", 100)]


def _worse(given: Recording, kind: type[Step], name: str) -> Recording:
    """`given` with `kind` at its fourth severity, or its fifth where frames are too far apart for that."""
    try:
        return perturbed(given, [kind.at(kind.ladder[3])], Dice(0, name))
    except SplashbenchError:
        return perturbed(given, [kind.at(kind.ladder[4])], Dice(0, name))


def _most_changed(given: Recording, worse: Recording) -> tuple[str, int]:
    """The view and the timestep, of some late ones, that show a change best."""
    times = range(given.n_frames // 2, given.n_frames, 3)
    return max(
        ((name, t) for name in given.views for t in times),
        key=lambda at: (
            float(np.abs(worse.image(*at).astype(int) - given.image(*at)).mean())
            + 255 * float((worse.mask(*at) ^ given.mask(*at)).mean())
        ),
    )


def tutorial() -> list[Path]:
    """The pictures of docs/tutorial.md: all cameras, and what scoring and the leaderboard draw."""
    scene, submissions = fits()
    runs = [WORK / "submissions" / name for name in ("nothing", "hull_points")]
    made(runs[0], "run", "nothing", str(SCENE), str(runs[0]), "--preset", "quick")
    made(runs[1], "run", "hull_points", str(SCENE), str(runs[1]))
    runs += [submissions["splashsplat"].directory]
    results, sheet = WORK / "results", WORK / "sheet.png"
    paths = [str(path) for path in runs]
    scored = ["--scene", str(SCENE), "--out", str(results), "--reference", paths[0]]
    made(results, "score", *paths, *scored)
    contact_sheet(scene, [Submission.open(path) for path in runs[1:]], sheet, [FRAME // 2, FRAME])
    with_chart = made(WORK / "leaderboard", "leaderboard", str(results), str(WORK / "leaderboard"))
    return [
        all_cameras(scene),
        shrink(sheet, IMAGES / "tutorial_contact_sheet.png", 1000),
        shrink(with_chart / "speed_accuracy.png", IMAGES / "tutorial_chart.png", 1100),
    ]


def all_cameras(scene: Scene) -> Path:
    """Every camera at one timestep with the outline of its mask."""
    figure = Figure(figsize=(10.5, 3.9), layout="constrained")
    grid = figure.subplots(2, 4).ravel()
    for axes in grid:
        axes.set_axis_off()
    for name, axes in zip([*scene.train, *scene.test], grid):
        axes.set_axis_on()
        bare(axes, f"camera {name}, {'test' if name in scene.test else 'training'}").imshow(scene.image(name, FRAME))
        axes.contour(scene.mask(name, FRAME), levels=[0.5], colors=[ORANGE], linewidths=0.6)
    return store(figure, "tutorial_scene.png", 110)


def videos() -> list[Path]:
    """The pictures of docs/videos.md: frames of `splashbench video`."""
    scene, submissions = fits()
    ours, other = (load(submissions[name].directory, SCENE) for name in METHODS)
    time = float(scene.times[FRAME]) + 0.3 * float(scene.times[FRAME + 1] - scene.times[FRAME])

    def frame(compared: Comparison | None = None, place: float = 0, **settings: Any) -> NDArray[np.uint8]:
        whole = {"start": time, "slow": 8.0} | settings
        film = make_film(ours, VideoSettings(**whole), compared)
        return film.frame(int(place * len(film)))

    def stored(name: str, *rows: Sequence[NDArray[np.uint8]]) -> Path:
        path = IMAGES / name
        Image.fromarray(np.concatenate([np.concatenate(row, axis=1) for row in rows])).save(path)
        # Colours that mean something are chosen with more care than those of photographs.
        small = Image.open(shrink(path, path, 1080, colours=0))
        small.quantize(256, kmeans=2, dither=Image.Dither.NONE).save(path, optimize=True)
        return path

    # Captions of one height, whatever they say.
    layers = [frame(layer=layer) for layer in LAYERS]
    tallest = max(len(layer) for layer in layers)
    layers = [np.pad(layer, ((0, tallest - len(layer)), (0, 0), (0, 0)), constant_values=20) for layer in layers]
    orbit = {"orbit": True, "end": time, "slow": None, "seconds": 2.0, "resize": 0.75}
    return [
        stored("video_layers.png", layers[:3], layers[3:]),
        stored("video_beside.png", [frame(Comparison([TRUTH, other]))]),
        stored("video_wipe.png", [frame(Comparison([TRUTH], "wipe", share)) for share in (0.45, 0.55)]),
        stored("video_orbit.png", [frame(place=place, **orbit) for place in (0, 0.18, 0.32, 0.5)]),
    ]


def dyes() -> list[Path]:
    """The picture of docs/restyling.md: three pours as reconstructed and with every dye that has a name."""
    rows = []
    for name, dye, frame in (("opaque_bowl", "blue", 18), ("glass_tank", "amber", 16), ("clear_liquid", "amber", 16)):
        scene, fit = WORK / f"{name}_{dye}", WORK / "submissions" / f"{name}_{dye}"
        made(scene, "synth", "scene", name, str(scene), "--size", "600x400", "--timesteps", "24", "--dye", dye)
        filmed = load(made(fit, "run", "splashsplat", str(scene), str(fit)))
        time, found = float(filmed.times[frame]), filmed_dye(filmed)
        shown = [filmed, *(restyled(filmed, dye, filmed=found) for dye in DYES.values())]
        views = [one.render(VIEW, time) for one in shown]
        top, left = (int(np.median(where)) for where in np.nonzero(views[0].alpha > 0.5))
        crop = slice(int(np.clip(top - 120, 0, 160)), None), slice(int(np.clip(left - 110, 0, 380)), None)
        rows.append(np.concatenate([view.rgb[crop][:240, :220] for view in views], axis=1))
    path = IMAGES / "dyes.jpg"
    Image.fromarray(to_8bit(np.concatenate(rows))).save(path, quality=84, optimize=True)
    return [path]


#: What `main` draws, by name.
GROUPS: dict[str, Callable[[], list[Path]]] = {
    "test_view": test_view,
    "method": method_pictures.method,
    "vessels": method_pictures.vessels,
    "standing": method_pictures.standing,
    "unmasked": method_pictures.unmasked,
    "rims": method_pictures.rims,
    "clocks": method_pictures.clocks,
    "cut_off": method_pictures.cut_off,
    "turned": method_pictures.turned,
    "falling": method_pictures.falling,
    "transmission": method_pictures.transmission,
    "perturbations": perturbations,
    "tutorial": tutorial,
    "videos": videos,
    "dyes": dyes,
}

if __name__ == "__main__":
    main(sys.argv[1:])
