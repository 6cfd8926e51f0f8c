"""What is made wrong with a recording: each kind does what it says, more of it does more, and nothing else changes."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh
from pydantic import ValidationError

from splashbench.errors import SplashbenchError
from splashbench.scene import Camera, Scene, look_at
from splashbench.scene.inspection import check_scene
from splashbench.study.perturbations import KINDS, Dice, Recording, Step, perturbed
from splashbench.study.perturbations.cameras import (
    CameraMoved,
    FocalError,
    LensDistortion,
    PoseRotation,
    PoseTranslation,
    PrincipalPointError,
    TightFraming,
)
from splashbench.study.perturbations.clocks import (
    ClockDrift,
    ClockOffset,
    ClockOffsets,
    DoubledFrames,
    DroppedFrames,
    MotionBlur,
    RollingShutter,
)
from splashbench.study.perturbations.images import (
    Compression,
    Defocus,
    Exposure,
    Gamma,
    Haze,
    MovingShadow,
    Passer,
    SensorNoise,
    WhiteBalance,
    to_linear,
    to_srgb,
)
from splashbench.study.perturbations.masks import (
    ErodedMasks,
    FlickeringMasks,
    GrownMasks,
    HoledMasks,
    WrongMasks,
)
from splashbench.study.perturbations.setup import ContainerMisplaced, GravityError, MissingCameras
from splashbench.study.scenes import changed_scene, recording_of
from splashbench.study.spec import StudyVariant
from splashbench.study.thinning import thinned
from splashbench.submission.withheld import kept_timesteps

WIDTH, HEIGHT, FRAMES = 96, 64, 8
DICE = Dice(3, "a recording")


def disc(name: str, t: float) -> np.ndarray:
    """A disc that moves right by four pixels a timestep, at another height in each camera."""
    rows, columns = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    return (columns - 30 - 4 * t) ** 2 + (rows - 24 - 4 * int(name)) ** 2 < 10**2


def picture(name: str, t: float) -> np.ndarray:
    """The disc on a gradient; the blue channel counts frames, sixteen to a timestep."""
    ground = np.broadcast_to(np.linspace(40, 200, WIDTH), (HEIGHT, WIDTH))
    grey = np.where(disc(name, t), 230, ground)
    return np.stack([grey, grey, np.full_like(grey, 16 * t)], axis=-1).astype(np.uint8)


def recording(finest: float = 0.0625, names: str = "1234") -> Recording:
    intrinsics = np.array([[90.0, 0, 48], [0, 90, 32], [0, 0, 1]])
    cameras = {}
    for name in names:
        eye = 3 * np.array([np.cos(int(name)), 0.4, np.sin(int(name))])
        cameras[name] = Camera(name, WIDTH, HEIGHT, intrinsics, look_at(eye))
    return Recording(
        cameras,
        FRAMES,
        0.032,
        picture,
        disc,
        finest,
        metres_per_unit=0.1,
        gravity=np.array([0.0, -1.0, 0.0]),
        container_pose=np.eye(4),
    )


def recording_for(kind: type[Step]) -> Recording:
    """One that can have `kind` at all severities."""
    return recording(names="1234567" if kind is MissingCameras else "1234")


def time_shown(worse: Recording, name: str, t: float) -> float:
    return float(worse.image(name, t)[0, 0, 2]) / 16


def severities(kind: type[Step]) -> list[Step]:
    return [kind.at(amount) for amount in kind.ladder]


def harm(worse: Recording, given: Recording) -> float:
    """Some measure of all that differs in what is seen."""
    total = 0.0
    assert given.gravity is not None
    assert given.container_pose is not None
    assert worse.gravity is not None
    assert worse.container_pose is not None
    total += np.abs(worse.gravity - given.gravity).sum() + np.abs(worse.container_pose - given.container_pose).sum()
    for name in given.views:
        if name not in worse.views:
            total += 1.0
            continue
        total += np.abs(worse.cameras[name].K - given.cameras[name].K).sum()
        total += np.linalg.norm(worse.cameras[name].w2c - given.cameras[name].w2c) * 100
        for t in range(FRAMES):
            total += float((worse.mask(name, t) ^ given.mask(name, t)).mean())
            total += float(np.abs(worse.image(name, t).astype(float) - given.image(name, t)).mean()) / 255
    return total


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.named())
def test_every_kind_has_five_severities_each_worse_than_the_last(kind: type[Step]) -> None:
    given, steps = recording_for(kind), severities(kind)
    assert len(steps) == 5
    assert kind.unit
    assert kind.__doc__
    # What is drawn is the same at every severity, but for frames and masks that are drawn by their number.
    unseen = [FRAMES - len(kept_timesteps(FRAMES, step.withheld)) for step in steps]
    worse = [harm(perturbed(given, [step], DICE), given) + left_out for step, left_out in zip(steps, unseen)]
    assert worse[0] > 0
    assert worse == sorted(worse)
    assert worse[-1] > 1.5 * worse[0]


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.named())
def test_a_seed_decides_all_and_pictures_may_be_asked_for_in_any_order(kind: type[Step]) -> None:
    step = severities(kind)[3]
    first, second = (perturbed(recording_for(kind), [step], DICE) for _ in range(2))
    assert first.views == second.views
    np.testing.assert_array_equal(first.gravity, second.gravity)
    np.testing.assert_array_equal(first.container_pose, second.container_pose)
    forward = [first.image(name, t) for name in first.views for t in range(FRAMES)]
    masks = [first.mask(name, t) for name in first.views for t in range(FRAMES)]
    for name in reversed(second.views):
        for t in reversed(range(FRAMES)):
            at = second.views.index(name) * FRAMES + t
            np.testing.assert_array_equal(second.mask(name, t), masks[at])
            np.testing.assert_array_equal(second.image(name, t), forward[at])
            assert forward[at].dtype == np.uint8
            assert masks[at].dtype == bool
    assert all(np.array_equal(first.cameras[n].w2c, second.cameras[n].w2c) for n in first.views)


@pytest.mark.parametrize("kind", [k for k in KINDS if "amount" in k.model_fields], ids=lambda kind: kind.named())
def test_none_of_it_changes_nothing(kind: type[Step]) -> None:
    if kind is Compression:
        return  # it has no such amount: rate factor 0 is another colour space
    assert kind.at(kind.none).withheld is None
    assert harm(perturbed(recording(), [kind.at(kind.none)], DICE), recording()) == pytest.approx(0, abs=1e-9)


@pytest.mark.parametrize("amount", [-1, float("nan"), float("inf"), 1e9])
def test_amounts_that_make_no_sense_are_refused(amount: float) -> None:
    for kind in KINDS:
        with pytest.raises(ValidationError):
            kind.at(amount)


def test_the_page_about_studies_lists_every_kind_with_its_severities() -> None:
    page = (Path(__file__).parents[2] / "docs" / "study.md").read_text(encoding="utf-8")
    rows = [line for line in page.splitlines() if re.match(r"\| `\w+` \| .* / ", line)]
    assert [re.findall(r"`(\w+)`", row)[0] for row in rows] == [kind.named() for kind in KINDS]
    for kind, row in zip(KINDS, rows):
        _, _, unit, ladder, *_ = (cell.strip() for cell in row.split("|"))
        assert unit == kind.unit
        assert ladder == " / ".join(f"{amount:g}" for amount in kind.ladder)


# --- clocks


def test_one_clock_is_off_by_what_is_said() -> None:
    worse = perturbed(recording(), [ClockOffset(amount=8)], DICE)  # a quarter of a timestep
    off = {name: time_shown(worse, name, 3) - 3 for name in worse.views}
    assert sorted(np.abs(list(off.values())).tolist()) == [0, 0, 0, 0.25]
    for name, shift in off.items():
        np.testing.assert_array_equal(worse.mask(name, 3), disc(name, 3 + shift))
    assert {time_shown(worse, name, 0) for name in worse.views} <= {0, 0.25}


def test_all_clocks_are_off_by_what_is_said_in_the_mean_square() -> None:
    worse = perturbed(recording(), [ClockOffsets(amount=32)], DICE)
    off = np.array([time_shown(worse, name, 3) - 3 for name in worse.views])
    assert off.mean() == pytest.approx(0, abs=0.1)
    assert np.sqrt((off**2).mean()) == pytest.approx(1.0, abs=0.1)


def test_a_drift_grows_from_the_first_frame_on() -> None:
    worse = perturbed(recording(), [ClockDrift(amount=100_000)], DICE)
    off = np.array([[time_shown(worse, name, t) - t for t in range(FRAMES - 1)] for name in worse.views])
    assert (np.abs(off).max(axis=1) > 0).sum() == 1
    (chosen,) = np.abs(off).max(axis=1).nonzero()[0]
    np.testing.assert_allclose(np.abs(off[chosen]), 0.1 * np.arange(FRAMES - 1), atol=0.07)


def test_offsets_between_recorded_frames_are_refused() -> None:
    for step in (ClockOffset(amount=8), ClockOffsets(amount=8), RollingShutter(amount=32), MotionBlur(amount=33)):
        with pytest.raises(SplashbenchError, match="frames were recorded 32 ms apart, and less than"):
            perturbed(recording(1.0), [step], DICE)
    worse = perturbed(recording(1.0), [ClockOffset(amount=33)], DICE)
    assert {abs(time_shown(worse, name, 3) - 3) for name in worse.views} == {0, 1}


def test_rows_of_a_rolling_shutter_are_of_their_time() -> None:
    worse = perturbed(recording(), [RollingShutter(amount=32)], DICE)
    times = worse.image("1", 3)[:, 0, 2] / 16
    np.testing.assert_allclose(times, 3 + (np.arange(HEIGHT) + 0.5) / HEIGHT - 0.5, atol=0.07)
    for row in (0, 20, 63):
        np.testing.assert_array_equal(worse.mask("1", 3)[row], disc("1", times[row])[row])


def test_frames_that_are_lost_or_doubled_move_all_later_ones() -> None:
    for step, sign in ((DroppedFrames(amount=0.25), 1), (DoubledFrames(amount=0.25), -1)):
        worse = perturbed(recording(), [step], DICE)
        off = np.array([[time_shown(worse, name, t) - t for t in range(FRAMES - 2)] for name in worse.views]) * sign
        (chosen,) = off.max(axis=1).nonzero()[0]
        assert off[chosen, 0] == 0
        assert set(np.diff(off[chosen])) <= {0, 1}
        assert off.max() <= 2


def test_blur_is_the_mean_light_of_what_was_recorded_meanwhile() -> None:
    blurred = perturbed(recording(), [MotionBlur(amount=32)], DICE).image("1", 3)
    light = np.mean([to_linear(picture("1", 3 + k / 16)) for k in range(-8, 9)], axis=0)
    np.testing.assert_array_equal(blurred, to_srgb(light))
    assert not np.array_equal(blurred, picture("1", 3))


# --- cameras


def test_a_camera_is_told_turned_about_its_centre() -> None:
    given = recording()
    worse = perturbed(given, [PoseRotation(amount=2.0)], DICE)
    axes = []
    for name in given.views:
        turn = worse.cameras[name].w2c[:3, :3] @ given.cameras[name].w2c[:3, :3].T
        axes.append(cv2.Rodrigues(turn)[0][:, 0])
        assert np.degrees(np.linalg.norm(axes[-1])) == pytest.approx(2.0)
        np.testing.assert_allclose(worse.cameras[name].center, given.cameras[name].center, atol=1e-9)
    assert np.linalg.norm(axes[0] - axes[1]) > 0.005


def test_a_camera_is_told_millimetres_away() -> None:
    given = recording()
    worse = perturbed(given, [PoseTranslation(amount=10)], DICE)
    for name in given.views:
        away = np.linalg.norm(worse.cameras[name].center - given.cameras[name].center)
        assert away * 0.1 == pytest.approx(0.010)
    with pytest.raises(SplashbenchError, match="metric scale is not known"):
        perturbed(replace(given, metres_per_unit=None), [PoseTranslation(amount=10)], DICE)


def test_intrinsics_are_told_off() -> None:
    given = recording()
    worse = perturbed(given, [FocalError(amount=5)], DICE)
    shares = [worse.cameras[name].K[0, 0] / 90 - 1 for name in given.views]
    assert 0.01 < np.sqrt(np.mean(np.square(shares))) < 0.15
    assert all(worse.cameras[name].K[1, 1] == worse.cameras[name].K[0, 0] for name in given.views)
    worse = perturbed(given, [PrincipalPointError(amount=4)], DICE)
    for name in given.views:
        assert np.linalg.norm((worse.cameras[name].K - given.cameras[name].K)[:2, 2]) == pytest.approx(4)


def test_distorted_pictures_are_what_a_distorting_lens_sees() -> None:
    given = recording()
    worse = perturbed(given, [LensDistortion(amount=0.1)], DICE)
    rows, columns = np.nonzero(worse.mask("1", 6))
    centre = np.array([[[columns.mean() + 0.5, rows.mean() + 0.5]]])
    camera = given.cameras["1"]
    straight = cv2.undistortPoints(centre, camera.K, np.array([-0.1, 0, 0, 0]), P=camera.K)[0, 0]
    rows, columns = np.nonzero(disc("1", 6))
    np.testing.assert_allclose(straight, [columns.mean() + 0.5, rows.mean() + 0.5], atol=0.2)


def test_a_knocked_camera_sees_as_if_turned_from_the_middle_on() -> None:
    given = recording()
    worse = perturbed(given, [CameraMoved(amount=2.0)], DICE)
    moved = [name for name in given.views if any((worse.mask(name, t) ^ disc(name, t)).any() for t in range(FRAMES))]
    (name,) = moved
    assert all(np.array_equal(worse.image(name, t), picture(name, t)) for t in range(FRAMES // 2))
    shifts = []
    for t in range(FRAMES // 2, FRAMES):
        before, after = (np.mean(np.nonzero(mask), axis=1) for mask in (disc(name, t), worse.mask(name, t)))
        shifts.append(after - before)
    assert np.ptp(shifts, axis=0).max() < 0.8  # one turn, and one only
    assert 0.2 < np.linalg.norm(np.mean(shifts, axis=0)) < 90 * np.tan(np.radians(2.0)) * 1.3


@pytest.mark.parametrize("amount", [0.35, 0.7])
def test_a_camera_that_is_zoomed_in_sees_a_part_and_knows(amount: float) -> None:
    given, times = recording(), 1 / (1 - amount)
    worse = perturbed(given, [TightFraming(amount=amount)], DICE)
    (name,) = (name for name in given.views if not np.array_equal(worse.cameras[name].K, given.cameras[name].K))
    before, after = given.cameras[name], worse.cameras[name]
    assert (after.width, after.height) == (WIDTH, HEIGHT)
    points = np.random.default_rng(0).normal(scale=0.1, size=(20, 3))
    middle = np.array([WIDTH, HEIGHT]) / 2
    np.testing.assert_allclose(
        after.project(points)[0] - middle, times * (before.project(points)[0] - middle), atol=1e-9
    )
    # The disc's middle is seen where the camera says, as long as the image has all of it.
    rows, columns = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    for t in range(FRAMES):
        at = times * (np.array([30 + 4 * t, 24 + 4 * int(name)]) - middle) + middle
        expected = (columns - at[0]) ** 2 + (rows - at[1]) ** 2 < (10 * times) ** 2
        assert (worse.mask(name, t) ^ expected).mean() < 0.02
    cut = [worse.mask(name, t)[:, [0, -1]].any() or worse.mask(name, t)[[0, -1]].any() for t in range(FRAMES)]
    assert any(cut) or amount < 0.5


# --- masks


def test_masks_lose_and_gain_pixels_along_their_outline() -> None:
    given = recording()
    rows, columns = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    away = np.hypot(columns - 42, rows - 28)
    for step, radius in ((ErodedMasks(amount=4), 6), (GrownMasks(amount=4), 14)):
        mask = perturbed(given, [step], DICE).mask("1", 3)
        assert (mask ^ (away < radius)).sum() < 0.06 * mask.sum() + 8
    assert not perturbed(given, [ErodedMasks(amount=16)], DICE).mask("1", 3).any()


def test_holes_take_the_share_that_is_said() -> None:
    worse = perturbed(recording(), [HoledMasks(amount=0.2)], DICE)
    first, second = worse.mask("1", 3), worse.mask("1", 4)
    assert not (first & ~disc("1", 3)).any()
    assert first.sum() == pytest.approx(0.8 * disc("1", 3).sum(), abs=2)
    assert not np.array_equal(first, np.roll(second, -4, axis=1))


def test_outlines_waver_and_no_more() -> None:
    worse = perturbed(recording(), [FlickeringMasks(amount=1)], DICE)
    rows, columns = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    away = np.hypot(columns - 42, rows - 28) - 10
    changed = worse.mask("1", 3) ^ disc("1", 3)
    assert changed.any()
    assert np.abs(away[changed]).max() < 4.5


def test_one_camera_has_the_masks_of_something_else() -> None:
    worse = perturbed(recording(), [WrongMasks(amount=0.5)], DICE)
    least = perturbed(recording(), [WrongMasks(amount=0.01)], DICE)
    assert sum((least.mask(n, t) != disc(n, t)).any() for n in least.views for t in range(FRAMES)) == 1
    wrong = np.array([[(worse.mask(n, t) != disc(n, t)).any() for t in range(FRAMES)] for n in worse.views])
    assert sorted(wrong.sum(axis=1)) == [0, 0, 0, FRAMES // 2]
    assert np.abs(np.diff(wrong.astype(int), axis=1)).sum() <= 2


# --- photographs


def test_light_is_changed_where_it_adds_up() -> None:
    image = picture("1", 3)
    np.testing.assert_array_equal(to_srgb(to_linear(image)), image)
    worse = perturbed(recording(), [Exposure(amount=1.0)], DICE)
    stops = []
    for name in worse.views:
        ratio = to_linear(worse.image(name, 0))[:, :20, 0] / to_linear(picture(name, 0))[:, :20, 0]
        stops.append(np.log2(np.median(ratio)))
    assert np.mean(stops) == pytest.approx(0, abs=0.1)
    assert np.sqrt(np.mean(np.square(stops))) == pytest.approx(1, abs=0.1)


def test_white_turns_red_or_blue_and_contrast_curves_differ() -> None:
    worse = perturbed(recording(), [WhiteBalance(amount=0.4)], DICE)
    warmth = [float(worse.image(n, 0)[0, 50, 0]) - float(worse.image(n, 0)[0, 50, 1]) for n in worse.views]
    assert min(warmth) < -3 < 3 < max(warmth)
    worse = perturbed(recording(), [Gamma(amount=0.4)], DICE)
    grey = [int(worse.image(name, 0)[0, 50, 0]) for name in worse.views]
    assert len(set(grey)) == 4


def test_noise_blur_and_haze_are_as_strong_as_is_said() -> None:
    given = recording()
    noise = perturbed(given, [SensorNoise(amount=10)], DICE).image("1", 5)[..., 0].astype(float)
    assert (noise - picture("1", 5)[..., 0])[~disc("1", 5)].std() == pytest.approx(10, rel=0.1)
    blurred = perturbed(given, [Defocus(amount=4)], DICE)
    sharp = [np.array_equal(blurred.image(name, 0), picture(name, 0)) for name in given.views]
    assert sorted(sharp) == [False, True, True, True]
    hazy = to_linear(perturbed(given, [Haze(amount=0.4)], DICE).image("1", 0))
    np.testing.assert_allclose(hazy, 0.6 * to_linear(picture("1", 0)) + 0.4 * 0.6, atol=0.005)


def test_a_shadow_moves_and_a_person_walks_behind_the_liquid() -> None:
    worse = perturbed(recording(), [MovingShadow(amount=0.8)], DICE)
    darker = [picture("1", t)[..., 0].astype(int) - worse.image("1", t)[..., 0] for t in range(FRAMES)]
    assert all(image.min() >= -1 for image in darker)
    assert max(image.max() for image in darker) > 40
    places = [np.unravel_index(image.argmax(), image.shape)[1] for image in darker if image.max() > 40]
    assert np.ptp(places) > 20
    worse = perturbed(recording(), [Passer(amount=0.8)], DICE)
    seen = 0
    for t in range(FRAMES):
        changed = (worse.image("1", t) != picture("1", t)).any(axis=-1)
        assert not (changed & disc("1", t)).any()
        seen += changed.any()
    assert seen > FRAMES / 2


@pytest.mark.parametrize("size", [(64, 96), (63, 95)])
def test_a_film_of_a_low_rate_has_as_many_frames_and_less_in_them(size: tuple[int, int]) -> None:
    height, width = size
    given = recording()
    cut = replace(given, image=lambda name, t: picture(name, t)[:height, :width])
    errors = []
    for rate_factor in (20, 48):
        worse = perturbed(cut, [Compression(amount=rate_factor)], DICE)
        assert worse.image("1", 7).shape == (height, width, 3)
        errors.append(np.abs(worse.image("1", 7)[..., 0].astype(float) - cut.image("1", 7)[..., 0]).mean())
    assert errors[0] < 6
    assert errors[1] > 1.5 * errors[0]


# --- scenes


def test_a_thinned_scene_shows_what_was_recorded_between_its_timesteps(balls: Scene, tmp_path: Path) -> None:
    thin = thinned(balls, 2, tmp_path / "thin")
    assert check_scene(thin.directory) == []
    assert (thin.name, thin.train, thin.test) == (balls.name, balls.train, balls.test)
    np.testing.assert_allclose(thin.times, balls.times[::2])
    for name in thin.cameras:
        for k in range(thin.n_frames):
            np.testing.assert_array_equal(thin.image(name, k), balls.image(name, 2 * k))
            np.testing.assert_array_equal(thin.mask(name, k), balls.mask(name, 2 * k))
    milliseconds = 1000 * float(balls.times[1] - balls.times[0])
    step = {"kind": "clock_offset", "amount": milliseconds}
    copy = changed_scene(thin, StudyVariant.model_validate({"name": "v", "perturbation": [step]}), 1, tmp_path / "c")
    (chosen,) = (n for n in thin.train if not np.array_equal(copy.mask(n, 1), thin.mask(n, 1)))
    assert any(np.array_equal(copy.image(chosen, 1), balls.image(chosen, t)) for t in (1, 3))
    assert thinned(balls, 2, tmp_path / "thin").directory == thin.directory
    with pytest.raises(SplashbenchError, match="leaves 1"):
        thinned(balls, balls.n_frames, tmp_path / "thin")


@pytest.mark.parametrize("every", [2, 1_000_000_000])
def test_a_scene_that_names_another_as_its_own_recording_is_refused(every: int, balls_copy: Path) -> None:
    said = {"schema_version": 1, "scene": str(balls_copy), "every": every}
    (balls_copy / "between.json").write_text(json.dumps(said))
    with pytest.raises(SplashbenchError, match=r"between\.json names .* other times or cameras; delete the file"):
        recording_of(Scene.open(balls_copy))
    (balls_copy / "between.json").write_text(json.dumps(said | {"scene": "/nowhere"}))
    with pytest.raises(SplashbenchError, match="nowhere"):
        recording_of(Scene.open(balls_copy))


def test_of_missing_cameras_fewer_are_among_more_and_two_are_left() -> None:
    given = recording(names="1234567")
    left = [set(perturbed(given, [MissingCameras(amount=n)], DICE).views) for n in range(6)]
    assert [len(views) for views in left] == [7, 6, 5, 4, 3, 2]
    assert all(more > fewer for more, fewer in pairwise(left))
    with pytest.raises(SplashbenchError, match="missing_cameras takes 6 of 7 training views, and 2 have to be left"):
        perturbed(given, [MissingCameras(amount=6)], DICE)


def test_gravity_is_stated_that_many_degrees_beside_itself() -> None:
    for amount in (1.0, 20.0, 90.0):
        stated = perturbed(recording(), [GravityError(amount=amount)], DICE).gravity
        assert stated is not None
        assert np.linalg.norm(stated) == pytest.approx(1)
        assert np.degrees(np.arccos(-stated[1])) == pytest.approx(amount)
    with pytest.raises(SplashbenchError, match="states gravity"):
        perturbed(replace(recording(), gravity=None), [GravityError(amount=1)], DICE)


def test_the_container_is_stated_that_far_away() -> None:
    pose = perturbed(recording(), [ContainerMisplaced(amount=5)], DICE).container_pose
    assert pose is not None
    assert np.linalg.norm(pose[:3, 3]) == pytest.approx(0.05)  # .1 m a unit
    angle = np.degrees(np.arccos((np.trace(pose[:3, :3]) - 1) / 2))
    assert angle == pytest.approx(0.5)
    for lacking in ({"container_pose": None}, {"metres_per_unit": None}):
        with pytest.raises(SplashbenchError, match="container_misplaced"):
            perturbed(replace(recording(), **lacking), [ContainerMisplaced(amount=5)], DICE)


def test_what_is_left_out_is_withheld_from_the_run(balls: Scene, tmp_path: Path) -> None:
    row = {"name": "v", "perturbation": [{"kind": "fewer_timesteps", "amount": 3}]}
    variant = StudyVariant.model_validate(row)
    assert (variant.unseen, variant.harm) == ("keep_1_of_3", ())
    assert changed_scene(balls, variant, 1, tmp_path) is balls
    both = StudyVariant.model_validate(
        row | {"perturbation": [{"kind": "exposure", "amount": 1}, {"kind": "uneven_timesteps", "amount": 0.35}]}
    )
    assert both.unseen == "drop_35_percent"
    assert [step.kind for step in both.harm] == ["exposure"]
    with pytest.raises(ValidationError, match="withheld twice: odd and keep_1_of_3"):
        StudyVariant.model_validate(row | {"withheld": "odd"})


def test_nothing_is_read_before_it_is_asked_for() -> None:
    def never(name: str, t: float) -> np.ndarray:
        raise AssertionError("read too early")

    for kind in KINDS:
        given = replace(recording_for(kind), image=never, mask=never)
        for step in severities(kind):
            perturbed(given, [step], DICE)


@pytest.mark.parametrize(
    "step",
    [
        {"kind": "exposure", "amount": 1.0},
        {"kind": "pose_rotation", "amount": 1.0},
        {"kind": "clock_offset", "amount": 33},
        {"kind": "lens_distortion", "amount": 0.3},
        {"kind": "grown_masks", "amount": 4},
    ],
    ids=lambda step: step["kind"],
)
def test_a_copy_differs_in_what_is_said_alone(step: dict, balls: Scene, tmp_path: Path) -> None:
    digest = balls.digest
    copy = changed_scene(balls, StudyVariant.model_validate({"name": "v", "perturbation": [step]}), 1, tmp_path)
    assert check_scene(copy.directory) == []
    assert (copy.name, copy.train, copy.test, copy.digest != digest) == (balls.name, balls.train, balls.test, True)
    np.testing.assert_array_equal(copy.times, balls.times)
    touched = {"images": 0, "masks": 0, "cameras": 0}
    for name, camera in balls.cameras.items():
        other = copy.cameras[name]
        touched["cameras"] += not (np.array_equal(other.K, camera.K) and np.array_equal(other.w2c, camera.w2c))
        for t in range(balls.n_frames):
            images = not np.array_equal(copy.image(name, t), balls.image(name, t))
            masks = not np.array_equal(copy.mask(name, t), balls.mask(name, t))
            touched["images"] += images
            touched["masks"] += masks
            assert name in balls.train or not (images or masks)
    for name in balls.test:
        np.testing.assert_array_equal(copy.cameras[name].w2c, balls.cameras[name].w2c)
    expected = {
        "exposure": {"images"},
        "pose_rotation": {"cameras"},
        "clock_offset": {"images", "masks"},
        "lens_distortion": {"images"},  # the balls are too near the middle
        "grown_masks": {"masks"},
    }
    assert {what for what, count in touched.items() if count} == expected[step["kind"]]
    assert Scene.open(balls.directory).digest == digest


def test_a_copy_lacks_cameras_and_states_the_setup_wrongly(balls_copy: Path, tmp_path: Path) -> None:
    trimesh.creation.box((0.1, 0.1, 0.1)).export(balls_copy / "box.ply")
    path = balls_copy / "scene.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"container_mesh": "box.ply", "metres_per_unit": 1.0}))
    scene, before = Scene.open(balls_copy), path.read_text()

    def copied(*steps: dict) -> Scene:
        return changed_scene(scene, StudyVariant.model_validate({"name": "v", "perturbation": steps}), 1, tmp_path)

    fewer = copied({"kind": "missing_cameras", "amount": 2}, {"kind": "exposure", "amount": 1.0})
    assert check_scene(fewer.directory) == []
    assert len(fewer.train) == len(scene.train) - 2
    assert set(fewer.train) < set(scene.train)
    assert fewer.test == scene.test
    assert not np.array_equal(fewer.image(fewer.train[0], 0), scene.image(fewer.train[0], 0))
    for name in fewer.train:
        np.testing.assert_array_equal(fewer.cameras[name].w2c, scene.cameras[name].w2c)
    tilted = copied({"kind": "gravity_error", "amount": 10})
    assert check_scene(tilted.directory) == []
    assert float(tilted.gravity @ scene.gravity) == pytest.approx(np.cos(np.radians(10)))
    moved = copied({"kind": "container_misplaced", "amount": 20})
    assert check_scene(moved.directory) == []
    mesh, other = scene.container_mesh(), moved.container_mesh()
    assert mesh is not None
    assert other is not None
    assert np.linalg.norm((other.vertices - mesh.vertices).mean(axis=0)) == pytest.approx(0.02, rel=0.01)
    assert path.read_text() == before


def test_what_a_scene_cannot_have_is_told(balls: Scene, tmp_path: Path) -> None:
    variant = StudyVariant.model_validate({"name": "v", "perturbation": [{"kind": "clock_offset", "amount": 1}]})
    with pytest.raises(SplashbenchError, match=r"clock_offset 1 ms: frames were recorded 57\.5 ms apart"):
        changed_scene(balls, variant, 0, tmp_path)
    assert not list(tmp_path.rglob("scene.json"))
