"""`make pictures`: every picture of README.md and of the site but for charts, drawn anew into docs/images.

Scenes and fits go into build/pictures; what is there already is kept. `python docs/tools/pictures.py test_view` draws
one of the groups below. Charts of results are drawn by docs/results/charts.py.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image
from scipy import ndimage

from splashbench.background.clean_plate import make_clean_plates
from splashbench.background.depth import depth_maps
from splashbench.container.footage_vessel import standing_about_liquid
from splashbench.container.mask_vessel import vessel_from_masks
from splashbench.container.verification import overlay
from splashbench.dyes import DYES
from splashbench.errors import SplashbenchError
from splashbench.observe import Grid, Silhouettes, sequence_bounds, signed_distance_frames
from splashbench.replay import load
from splashbench.report.contact_sheet import contact_sheet
from splashbench.restyle import filmed_dye, restyled
from splashbench.scene import Scene
from splashbench.scene.scene import TrainingScene
from splashbench.selfcalibration.thickness import REACH, Thickness, agreement, courses
from splashbench.selfcalibration.unmasked import outlines_by_change
from splashbench.study.perturbations import KINDS, Dice, Recording, Step, perturbed
from splashbench.study.perturbations.cameras import TightFraming
from splashbench.study.perturbations.setup import MissingCameras
from splashbench.study.perturbations.timesteps import FewerTimesteps
from splashbench.study.scenes import recording_of
from splashbench.submission import Submission, to_8bit
from splashbench.video import TRUTH, Comparison, VideoSettings, make_film
from splashbench.video.layers import LAYERS
from splashbench_methods.splashsplat.fields.container import known_container
from splashbench_methods.splashsplat.fields.near_wall import near_wall
from splashbench_methods.splashsplat.fields.rim import rim_of

ROOT = Path(__file__).parents[2]
IMAGES = ROOT / "docs" / "images"
WORK = ROOT / "build" / "pictures"
SCENE = WORK / "scene"
POUR = ("synth", "scene", "opaque_bowl")
METHODS = {"splashsplat": "SplashSplat (this project)", "scaffold_4d": "4D-Scaffold-GS (best baseline)"}
SMALL = ("--size", "240x160", "--times-alone")
VIEW, FRAME = "6", 8
ORANGE, BLUE = "#E69F00", "#0072B2"


def main(names: Sequence[str]) -> None:
    """Draw the groups of pictures that `names` lists; all of them by default."""
    matplotlib.rcParams.update({"font.family": "DejaVu Sans", "font.size": 10})
    IMAGES.mkdir(parents=True, exist_ok=True)
    for name in names or GROUPS:
        for path in GROUPS[name]():
            print(f"{path.relative_to(ROOT)}: {path.stat().st_size / 1000:.0f} kB")


def made(folder: Path, *command: str) -> Path:
    """`folder`, made by a splashbench command unless it is there."""
    if not folder.exists():
        subprocess.run([sys.executable, "-m", "splashbench", *command], check=True)
    return folder


def fits() -> tuple[Scene, dict[str, Submission]]:
    """The synthetic scene, and the methods of METHODS on it, by their presets `quick`."""
    made(SCENE, *POUR, str(SCENE), "--size", "480x320", "--timesteps", "12")
    submissions = {}
    for name in METHODS:
        out = WORK / "submissions" / name
        submissions[name] = Submission.open(made(out, "run", name, str(SCENE), str(out), "--preset", "quick"))
    return Scene.open(SCENE), submissions


def fits_told_nothing() -> tuple[Scene, dict[str, Submission]]:
    """The same pour, whose scene tells the times alone; splashsplat by `best`, and the rival at full size."""
    folder = WORK / "told_nothing"
    size = ["--size", "480x320", "--timesteps", "12", "--times-alone"]
    scene = made(folder / "scene", *POUR, str(folder / "scene"), *size)
    settings = {"splashsplat": ["--preset", "best"], "scaffold_4d": ["--preset", "quick", "--set", "longest_side=480"]}
    submissions = {}
    for name in METHODS:
        out = folder / name
        submissions[name] = Submission.open(made(out, "run", name, str(scene), str(out), *settings[name]))
    return Scene.open(scene), submissions


def store(figure: Figure, name: str, dpi: int = 150, colours: int = 256) -> Path:
    """Write the figure as a PNG without margins."""
    path = IMAGES / name
    figure.savefig(path, dpi=dpi, facecolor="white", bbox_inches="tight", pad_inches=0.05, metadata={"Software": None})
    return shrink(path, path, colours=colours)


def shrink(source: Path, path: Path, width: int | None = None, colours: int = 256) -> Path:
    """Write the picture `source` with at most `colours` colours (0: all), and scaled down to `width` pixels."""
    image = Image.open(source).convert("RGB")
    if width and width < image.width:
        image = image.resize((width, round(image.height * width / image.width)), Image.Resampling.LANCZOS)
    small = image.quantize(colours, dither=Image.Dither.NONE) if colours else image
    small.save(path, optimize=True)
    return path


def bare(axes: Axes, title: str = "") -> Axes:
    """Axes for an image: no ticks, no frame."""
    axes.set_xticks([])
    axes.set_yticks([])
    for spine in axes.spines.values():
        spine.set_visible(False)
    axes.set_title(title, fontsize=10)
    return axes


def window(mask: NDArray[np.bool_], margin: int = 14) -> tuple[slice, slice]:
    """Rows and columns around the pixels of `mask`."""
    rows, columns = (np.flatnonzero(mask.any(axis=axis)) for axis in (1, 0))
    return (
        slice(max(0, rows[0] - margin), rows[-1] + margin + 1),
        slice(max(0, columns[0] - margin), columns[-1] + margin + 1),
    )


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


def method() -> list[Path]:
    """The figures of docs/method.md: silhouettes, signed distance, carriers, rendering; and how long carriers live."""
    scene, submissions = fits()
    submission = submissions["splashsplat"]
    particles = submission.particles()
    assert particles is not None
    return [silhouettes(scene), four_steps(scene, submission), lives(particles.active, scene.times)]


def silhouettes(scene: Scene) -> Path:
    """The training views of one timestep with the outline of their masks."""
    figure = Figure(figsize=(10, 1.75), layout="constrained")
    for name, axes in zip(scene.train, figure.subplots(1, len(scene.train))):
        mask = scene.mask(name, FRAME)
        crop = window(mask, 20)
        bare(axes, f"training view {name}").imshow(scene.image(name, FRAME)[crop])
        axes.contour(mask[crop], levels=[0.5], colors=[ORANGE], linewidths=1)
    return store(figure, "method_silhouettes.png", 130)


def four_steps(scene: Scene, submission: Submission) -> Path:
    """Signed distance, carriers with their speed, opacity and rendering of one timestep."""
    geometry, particles = submission.geometry(), submission.particles()
    assert geometry is not None
    assert particles is not None
    camera = scene.cameras[VIEW]
    crop = window(scene.mask(VIEW, FRAME))
    figure = Figure(figsize=(10.5, 3.1), layout="constrained")
    left, middle, right, last = figure.subplots(1, 4)

    phi = geometry.phi[FRAME].astype(np.float32) / 16
    up = int(np.abs(scene.gravity).argmax()) if scene.gravity is not None else 1
    across = max((axis for axis in range(3) if axis != up), key=lambda axis: phi.shape[axis])
    nearest = np.moveaxis(phi, (up, across), (0, 1)).min(axis=2)
    upwards = scene.gravity is None or scene.gravity[up] < 0
    bare(left, "signed distance").set_anchor("N")
    drawn = left.imshow(nearest, cmap="RdBu", vmin=-8, vmax=8, origin="lower" if upwards else "upper")
    left.contour(nearest, levels=[0], colors="black", linewidths=0.8)
    figure.colorbar(drawn, ax=left, location="bottom", shrink=0.8, label="voxels, least along the depth")

    pixels, _ = camera.project(particles.at(FRAME))
    velocities = particles.velocities
    speed = (
        np.zeros(len(pixels))
        if velocities is None
        else np.linalg.norm(velocities[FRAME][particles.active[FRAME]], axis=1)
    )
    bare(middle, "carriers and their speed").imshow(scene.image(VIEW, FRAME), alpha=0.25)
    dots = middle.scatter(*pixels.T, c=speed * (scene.metres_per_unit or 1), s=1.2, cmap="viridis", linewidths=0)
    figure.colorbar(dots, ax=middle, location="bottom", shrink=0.8, label="m/s")
    middle.set_xlim(crop[1].start, crop[1].stop)
    middle.set_ylim(crop[0].stop, crop[0].start)

    shown = bare(right, "opacity of their Gaussians").imshow(
        submission.alpha(VIEW, FRAME)[crop], cmap="gray", vmin=0, vmax=1
    )
    figure.colorbar(shown, ax=right, location="bottom", shrink=0.8, label="0 to 1")
    bare(last, "rendered, test view").imshow(submission.rendering(VIEW, FRAME)[crop])
    return store(figure, "method_steps.png", 110, colours=0)


def vessels() -> list[Path]:
    """The vessels found in the container masks, over two training views of each scene."""
    figure = Figure(figsize=(10, 1.8), layout="constrained")
    panels = iter(figure.subplots(1, 4))
    for name in ("opaque_bowl", "glass_tank"):
        folder = WORK / f"{name}_of_two_frames"
        scene = Scene.open(made(folder, "synth", "scene", name, str(folder), "--size", "480x320", "--timesteps", "2"))
        masks = {view: mask for view in scene.train if (mask := scene.container_mask(view)) is not None}
        vessel = vessel_from_masks([scene.cameras[view] for view in scene.train], masks)
        assert vessel is not None
        for view in (scene.train[0], scene.train[2]):
            picture = overlay(vessel.mesh, np.eye(4), scene.cameras[view], masks[view], scene.image(view, 0))
            bare(next(panels)).imshow(picture[window(masks[view], 30)])
    return [store(figure, "method_vessel.png", 130)]


def standing() -> list[Path]:
    """What speaks for the container in two scenes: heights in the clean plates, and liquid that rests in glass. And the
    vessels found."""
    figure = Figure(figsize=(10, 1.8), layout="constrained")
    panels = iter(figure.subplots(1, 4))
    for name, timesteps in (("opaque_bowl", 8), ("glass_tank", 50)):
        folder = WORK / f"{name}_without_masks"
        size, steps = ("--size", "480x320"), ("--timesteps", str(timesteps))
        made(folder, "synth", "scene", name, str(folder), *size, *steps, "--times-alone")
        scene = Scene.open(folder).training()
        plates = make_clean_plates(scene)
        found = standing_about_liquid(scene, plates)
        assert found.support is not None
        assert found.vessel is not None
        view = scene.train[1]
        mask = found.vessel.masks([scene.cameras[view]])[view]
        room = window(mask, 60)
        if found.vessel.seen_through:
            later = range(scene.n_frames // 2, scene.n_frames)
            wet = np.mean([scene.mask(view, t) for t in later], axis=0)
            bare(next(panels)).imshow(wet[room], cmap="viridis", vmin=0, vmax=1)
        else:
            depth = depth_maps(scene.initial_points(), list(plates.values()))[1]
            heights = np.where(depth.trusted, found.support.heights(depth.lifted()), np.nan)
            # The sweep sees plates of its own size.
            scale = heights.shape[0] / mask.shape[0]
            part = tuple(slice(round(side.start * scale), round(side.stop * scale)) for side in room)
            bare(next(panels)).imshow(heights[part], cmap="viridis", vmin=0, vmax=0.12)
        picture = bare(next(panels))
        picture.imshow(plates[view].image[room])
        picture.contour(mask[room], levels=[0.5], colors=[BLUE], linewidths=1.2)
    return [store(figure, "method_standing.png", 130)]


class _Unmasked(TrainingScene):
    """A scene of which no mask shows anything."""

    def __init__(self, scene: Scene) -> None:
        super().__init__(scene)
        self._masks = {name: np.zeros((camera.height, camera.width), bool) for name, camera in self.cameras.items()}

    def mask(self, camera: str, t: int) -> NDArray[np.bool_]:
        return self._masks[camera]


def unmasked() -> list[Path]:
    """The liquid of four scenes as it is found where no mask shows any."""
    names, frames = ("opaque_bowl", "glossy_bowl", "glass_tank", "clear_liquid"), (4, 12, 24, 44)
    figure = Figure(figsize=(12, 8.4), layout="constrained")
    panels = iter(figure.subplots(len(names), len(frames)).flat)
    for name in names:
        folder = WORK / f"{name}_240"
        made(folder, "synth", "scene", name, str(folder), "--size", "240x160", "--times-alone")
        scene = _Unmasked(Scene.open(folder))
        view = scene.train[0]
        found = outlines_by_change(scene, [view])[view].masks
        for t in frames:
            panel = bare(next(panels), f"{name}, frame {t}")
            panel.imshow(scene.image(view, t))
            if found[t].any():
                panel.contour(found[t], levels=[0.5], colors=[ORANGE], linewidths=1.0)
    return [store(figure, "unmasked.png", 110)]


def transmission() -> list[Path]:
    """A test view of a glass tank, and how far off it is with and without what is behind the liquid showing through."""
    name, view, t = "glass_tank", "7", 20
    folder = WORK / f"{name}_240"
    scene = Scene.open(made(folder, "synth", "scene", name, str(folder), "--size", "240x160", "--times-alone"))
    mask, truth = scene.mask(view, t), scene.image(view, t)
    crop = window(mask)
    figure = Figure(figsize=(11, 4.4), layout="constrained")
    panels = iter(figure.subplots(1, 5).flat)
    bare(next(panels), "truth").imshow(truth[crop], interpolation="lanczos")
    for setting, title in (("never", "colours alone"), ("measured", "background shows through")):
        out = folder.with_name(f"{name}_240_transmission_{setting}")
        told = ("--set", "container_masks=false", "--set", f"transmission={setting}")
        made(out, "run", "splashsplat", str(folder), str(out), "--preset", "best", *told)
        shown = Submission.open(out).rendering(view, t)
        error = np.abs(shown.astype(float) - truth).mean(axis=2)
        quality = 10 * np.log10(255**2 / np.square(shown.astype(float) - truth)[mask].mean())
        bare(next(panels), title).imshow(shown[crop], interpolation="lanczos")
        off = bare(next(panels), f"off by ({quality:.1f} dB)")
        off.imshow(np.where(mask, error, 0)[crop], cmap="magma", vmin=0, vmax=30)
    return [store(figure, "transmission.png", 110)]


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


def rims() -> list[Path]:
    """A rim as the container masks have it, and moved to where liquid masks end, over a view of a pool; and the
    wall's share of its pixels."""
    folder = WORK / "still_pool_small"
    scene = Scene.open(made(folder, "synth", "scene", "still_pool", str(folder), "--size", "240x160"))
    training = scene.training()
    view, frame = scene.train[2], scene.n_frames // 2
    vessel = known_container(training, mesh=False, from_masks=True)
    moved = rim_of(vessel, training, np.zeros((scene.n_frames, len(scene.train)), dtype=bool))
    assert moved.room is not None
    assert moved.up is not None
    assert vessel.occlusion is not None
    walls = [
        near_wall(mesh, moved.room, moved.up, scene.cameras[view], 0.0) for mesh in (vessel.occlusion.mesh, moved.mesh)
    ]
    mask = scene.mask(view, frame)
    pieces, _ = ndimage.label(mask)
    rows, columns = window(pieces == np.bincount(pieces[mask]).argmax(), 4)
    rows = slice(rows.start + (rows.stop - rows.start) // 2, rows.stop)
    extent = (columns.start - 0.5, columns.stop - 0.5, rows.stop - 0.5, rows.start - 0.5)
    figure = Figure(figsize=(10, 2.2), layout="constrained")
    left, right = figure.subplots(1, 2)
    bare(left, "the rim as found (orange), and moved to where masks end (blue)")
    left.imshow(scene.image(view, frame)[rows, columns], extent=extent)
    for wall, color in zip(walls, (ORANGE, BLUE)):
        assert wall is not None
        left.contour(wall.share, levels=[0.5], colors=[color], linewidths=1.5)
    assert walls[1] is not None
    bare(right, "what the wall takes of each pixel (white), and the liquid mask's outline")
    right.imshow(walls[1].share[rows, columns], extent=extent, cmap="gray", vmin=0, vmax=1)
    right.contour(mask, levels=[0.5], colors=[ORANGE], linewidths=1)
    for axes in (left, right):
        axes.set_xlim(*extent[:2])
        axes.set_ylim(*extent[2:])
    return [store(figure, "method_rim.png", 130)]


def clocks() -> list[Path]:
    """How thick the liquid is in the planes of two cameras over time, one of them on a clock that is off, and how well
    that agrees at any offset."""
    scene = Scene.open(made(WORK / "told_nothing_small", *POUR, str(WORK / "told_nothing_small"), *SMALL))
    late, names = 5, (scene.train[0], scene.train[3])
    frames = np.arange(late, scene.n_frames - late)
    views = [
        Thickness.of([scene.mask(name, int(t)) for t in frames + off], scene.cameras[name])
        for name, off in zip(names, (0, late))
    ]
    seen = courses(*views)
    assert seen is not None
    lags = np.arange(-REACH, REACH + 1)
    figure = Figure(figsize=(10, 2.6), layout="constrained")
    panels = figure.subplots(1, 3)
    for axes, name, course, off in zip(panels, names, seen, ("", f", {late} timesteps late")):
        axes.imshow(course.T, aspect="auto", cmap="magma", origin="lower")
        axes.set_title(f"camera {name}{off}", fontsize=10)
        axes.set_xlabel("timestep")
        axes.set_yticks([])
    panels[0].set_ylabel("planes through both cameras")
    # Of what the second shows so much later, it is told to show that much too late.
    panels[2].plot(lags, [agreement(*seen, -int(lag)) for lag in lags], color=BLUE, marker="o", markersize=3)
    panels[2].axvline(late, color=ORANGE)
    panels[2].set_xlabel("offset of the second clock, timesteps")
    panels[2].set_title("agreement; the true offset (orange)", fontsize=10)
    return [store(figure, "method_clocks.png", 120)]


def cut_off() -> list[Path]:
    """A view that frames its liquid too tightly, and hulls of another view's liquid with and without its say past its
    sides."""
    scene = Scene.open(made(WORK / "told_nothing_small", *POUR, str(WORK / "told_nothing_small"), *SMALL))
    tight = perturbed(recording_of(scene, list(scene.train)), [TightFraming(amount=0.5)], Dice(0, scene.name))
    (name,) = (name for name in tight.views if not np.array_equal(tight.cameras[name].K, scene.cameras[name].K))
    frame, other = scene.n_frames * 3 // 5, scene.train[0] if name != scene.train[0] else scene.train[1]
    camera = scene.cameras[other]
    outlines = []
    for has_a_say in (True, False):
        silhouettes = Silhouettes(_Pictures(tight))
        if has_a_say:
            silhouettes.cut_off = [None] * len(silhouettes.views)
        grid = Grid.over(sequence_bounds(silhouettes).padded(0.1), 160)
        phi = next(signed_distance_frames(silhouettes, grid, frames=[frame]))
        places, _ = camera.project(grid.to_scene(np.argwhere(phi < 0)))
        column, row = np.floor(places).astype(int).T
        inside = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
        hull = np.zeros((camera.height, camera.width), dtype=bool)
        hull[row[inside], column[inside]] = True
        outlines.append(ndimage.binary_closing(hull, iterations=2))
    figure = Figure(figsize=(10, 2.5), layout="constrained")
    left, middle, right = figure.subplots(1, 3)
    bare(left, "a camera that frames too tightly").imshow(tight.image(name, frame))
    left.contour(tight.mask(name, frame), levels=[0.5], colors=["white"], linewidths=1)
    for axes, hull, title in (
        (middle, outlines[0], "hull, if its sides end the liquid"),
        (right, outlines[1], "hull, if it says nothing past them"),
    ):
        bare(axes, title).imshow(scene.image(other, frame))
        axes.contour(hull, levels=[0.5], colors=[ORANGE], linewidths=1.2)
    return [store(figure, "method_cut_off.png", 120)]


class _Pictures:
    """A `Recording` as carving needs it."""

    def __init__(self, recording: Recording) -> None:
        self.name, self.cameras = "recording", recording.cameras
        self.train, self.n_frames = tuple(recording.views), recording.n_frames
        self._recording = recording

    def mask(self, camera: str, t: int) -> NDArray[np.bool_]:
        return self._recording.mask(camera, t)


def lives(active: NDArray[np.bool_], times: NDArray[np.float64]) -> Path:
    """How many carriers of each frame were born there, and how many came from an earlier frame."""
    born = active & ~np.roll(active, 1, axis=0)
    born[0] = active[0]
    new, older = born.sum(axis=1), (active & ~born).sum(axis=1)
    figure = Figure(figsize=(6.5, 2.4), layout="constrained")
    axes = figure.subplots()
    width = 0.8 * float(np.diff(times).mean()) * 1000
    axes.bar(times * 1000, older, width, color=BLUE, label="carried from the frame before")
    axes.bar(times * 1000, new, width, bottom=older, color=ORANGE, label="new in this frame")
    axes.set_xlabel("time, ms")
    axes.set_ylabel("carriers")
    axes.legend(frameon=False, fontsize=9)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    return store(figure, "method_carriers.png", 130)


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
    "method": method,
    "vessels": vessels,
    "standing": standing,
    "unmasked": unmasked,
    "rims": rims,
    "clocks": clocks,
    "cut_off": cut_off,
    "transmission": transmission,
    "perturbations": perturbations,
    "tutorial": tutorial,
    "videos": videos,
    "dyes": dyes,
}

if __name__ == "__main__":
    main(sys.argv[1:])
