"""The pictures of docs/method.md, which pictures.py draws: what is seen, what is found in it, what is made of it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
from drawing import BLUE, FRAME, ORANGE, POUR, SMALL, VIEW, WORK, bare, fits, made, store, window
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy import ndimage

from splashbench.background.clean_plate import make_clean_plates
from splashbench.background.depth import depth_maps
from splashbench.container.footage_vessel import standing_about_liquid
from splashbench.container.mask_vessel import vessel_from_masks
from splashbench.container.verification import overlay
from splashbench.observe import Grid, Silhouettes, sequence_bounds, signed_distance_frames
from splashbench.scene import Camera, Scene
from splashbench.scene.scene import TrainingScene
from splashbench.selfcalibration.cameras import fit_cameras
from splashbench.selfcalibration.features import find_tracks
from splashbench.selfcalibration.thickness import REACH, Thickness, agreement, courses
from splashbench.selfcalibration.unmasked import outlines_by_change
from splashbench.study.perturbations import Dice, Recording, perturbed
from splashbench.study.perturbations.cameras import PoseRotation, TightFraming
from splashbench.study.scenes import recording_of
from splashbench.submission import Submission
from splashbench_methods.splashsplat.fields.container import known_container
from splashbench_methods.splashsplat.fields.near_wall import near_wall
from splashbench_methods.splashsplat.fields.rim import rim_of

#: Timesteps of the small pour in which its first drop and its last fall.
_FALLING = (1, 3, 45)


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
        outlines.append(_hull_seen(silhouettes, frame, camera))
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


def turned() -> list[Path]:
    """The hull as a test view sees it: by cameras that are all told turned, as points in common alone say that they
    stand, and as sparse points say beside."""
    scene = Scene.open(made(WORK / "told_nothing_small", *POUR, str(WORK / "told_nothing_small"), *SMALL))
    training, frame, test = scene.training(), scene.n_frames * 3 // 5, scene.cameras[scene.test[0]]
    told = perturbed(recording_of(scene, list(scene.train)), [PoseRotation(amount=2.0)], Dice(1, scene.name))
    plates = {name: plate.without_beside() for name, plate in make_clean_plates(training).items()}
    tracks = find_tracks(plates, told.cameras)
    cameras: list[tuple[str, Mapping[str, Camera]]] = [("cameras as told, each turned by 2°", told.cameras)]
    for title, points in (
        ("by points that cameras have in common", lambda: None),
        ("and by sparse points", scene.initial_points),
    ):
        found = fit_cameras(tracks, told.cameras, points, lambda given: find_tracks(plates, given))
        assert found is not None
        cameras.append((title, found.cameras))
    mask = scene.mask(test.name, frame)
    crop = window(mask, 12)
    figure = Figure(figsize=(10, 3.1), layout="constrained")
    for axes, (title, given) in zip(figure.subplots(1, 3), cameras):
        hull = _hull_seen(Silhouettes(_Pictures(told.with_cameras(lambda one, at=given: at[one.name]))), frame, test)
        bare(axes, title).imshow(scene.image(test.name, frame)[crop])
        axes.contour(mask[crop], levels=[0.5], colors=["white"], linewidths=1)
        axes.contour(hull[crop], levels=[0.5], colors=[ORANGE], linewidths=1.2)
    return [store(figure, "method_turned.png", 120)]


def falling() -> list[Path]:
    """Timesteps that no fit saw, in a test view: as photographed, and by carriers that do not and do fall."""
    folder = made(WORK / "told_nothing_small", *POUR, str(WORK / "told_nothing_small"), *SMALL)
    scene = Scene.open(folder)
    view = scene.test[0]
    shown: dict[str, Callable[[str, int], NDArray[np.uint8]]] = {"as photographed": scene.image}
    for title, falls in (("no jet is known", "false"), ("the jet falls as its ends tell", "true")):
        out = WORK / f"falling_{falls}"
        settings = ("--preset", "quick", "--withhold", "odd", "--set", f"ballistic={falls}")
        shown[title] = Submission.open(made(out, "run", "splashsplat", str(folder), str(out), *settings)).rendering
    figure = Figure(figsize=(6.6, 6.8), layout="constrained")
    for row, frame in zip(figure.subplots(len(_FALLING), 3), _FALLING):
        crop = window(scene.mask(view, scene.n_frames // 2), 12)
        for axes, (title, picture) in zip(row, shown.items()):
            bare(axes, title if frame == _FALLING[0] else "").imshow(picture(view, frame)[crop])
    return [store(figure, "method_falling.png", 110)]


def _hull_seen(silhouettes: Silhouettes, frame: int, camera: Camera) -> NDArray[np.bool_]:
    """Where `camera` sees the hull of `frame`, [H, W]."""
    grid = Grid.over(sequence_bounds(silhouettes).padded(0.1), 160)
    phi = next(signed_distance_frames(silhouettes, grid, frames=[frame]))
    places, _ = camera.project(grid.to_scene(np.argwhere(phi < 0)))
    column, row = np.floor(places).astype(int).T
    inside = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
    hull = np.zeros((camera.height, camera.width), dtype=bool)
    hull[row[inside], column[inside]] = True
    return np.asarray(ndimage.binary_closing(hull, iterations=2))


class _Pictures:
    """A `Recording` as carving needs it."""

    def __init__(self, recording: Recording) -> None:
        self.name, self.cameras = "recording", recording.cameras
        self.train, self.n_frames = tuple(recording.views), recording.n_frames
        self._recording = recording

    def mask(self, camera: str, t: int) -> NDArray[np.bool_]:
        return self._recording.mask(camera, t)
