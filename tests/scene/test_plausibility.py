"""`scene check` finds cameras that no rig has, and a scale that nothing filmed has."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError

from splashbench.scene import Camera, Scene, SceneMeta, look_at
from splashbench.scene.inspection import check_scene


def edit(path: Path, change: Callable[[dict], object]) -> None:
    data = json.loads(path.read_text())
    change(data)
    path.write_text(json.dumps(data))


def set_camera(key: str, value: object, camera: int = 1) -> Callable[[Path], None]:
    """Give a training camera another matrix in every frame."""

    def change(directory: Path) -> None:
        matrix = np.asarray(value).tolist()
        edit(directory / "train_meta.json", lambda data: [row.__setitem__(camera, matrix) for row in data[key]])

    return change


def set_field(name: str, value: object) -> Callable[[Path], None]:
    return lambda directory: edit(directory / "scene.json", lambda data: data.__setitem__(name, value))


def turned_away(directory: Path) -> None:
    """Camera 2 looks the other way from where it stands."""
    camera = Scene.open(directory).cameras["2"]
    axis = camera.w2c[2, :3]
    set_camera("w2c", look_at(camera.center, camera.center - axis, up=(0, 1, 0)))(directory)


def turned_aside(directory: Path) -> None:
    camera = Scene.open(directory).cameras["2"]
    axis = np.cross(camera.w2c[2, :3], [0, 1, 0])
    set_camera("w2c", look_at(camera.center, camera.center + axis, up=(0, 1, 0)))(directory)


def twice(directory: Path) -> None:
    first = Scene.open(directory).cameras["1"]
    set_camera("w2c", first.w2c)(directory)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (set_camera("k", [[100, 0, 48], [0, 100, 32], [0, 0, 0]]), "camera 2: K is not that of a pinhole"),
        (set_camera("k", [[100, 50, 48], [0, 100, 32], [0, 0, 1]]), "camera 2: K has skew"),
        (set_camera("k", [[100, 0, 48], [7, 100, 32], [0, 0, 1]]), "camera 2: K is not that of a pinhole"),
        (set_camera("k", [[1e-6, 0, 48], [0, 1e-6, 32], [0, 0, 1]]), "camera 2: its angle of view is 180 degrees"),
        (set_camera("k", [[1e8, 0, 48], [0, 1e8, 32], [0, 0, 1]]), "camera 2: its angle of view is"),
        (set_camera("k", [[100, 0, 48], [0, 900, 32], [0, 0, 1]]), "camera 2: its focal lengths are 100 and 900"),
        (set_camera("k", [[100, 0, 1e6], [0, 100, 32], [0, 0, 1]]), "camera 2: its principal point"),
        (set_camera("w2c", [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 0]]), "w2c does not end in 0 0 0 1"),
        (turned_away, "camera 2 looks away"),
        (turned_aside, "camera 2 looks away"),
        (twice, "cameras 1 and 2 are one"),
        (set_field("metres_per_unit", 1e-8), "metres_per_unit is 1e-08, not 1e-06 to 1000"),
        (set_field("metres_per_unit", 1e8), "metres_per_unit is 1e+08, not 1e-06 to 1000"),
        (set_field("metres_per_unit", 900.0), "the cameras stand"),
        (set_field("metres_per_unit", 1e-5), "the cameras stand"),
    ],
)
def test_what_no_rig_has_is_a_fault(change: Callable[[Path], None], said: str, balls_copy: Path) -> None:
    assert check_scene(balls_copy) == []
    change(balls_copy)
    faults = check_scene(balls_copy)
    assert [said in fault for fault in faults] == [True]


def test_cameras_side_by_side_look_away_from_nothing(balls_copy: Path) -> None:
    """Their lines of sight part; none of them is at fault."""
    for split, names in (("train", range(5)), ("test", range(2))):
        poses = [
            look_at((x, 0, -3), (1.1 * x, 0, 0)) for x in (0.1 * n + (0.05 if split == "test" else 0) for n in names)
        ]
        edit(
            balls_copy / f"{split}_meta.json",
            lambda data, poses=poses: data.update(w2c=[[pose.tolist() for pose in poses]] * len(data["w2c"])),
        )
    assert check_scene(balls_copy) == []


def test_a_crop_far_from_the_axis_is_no_fault(balls: Scene) -> None:
    from splashbench.scene.plausibility import _absurd

    camera = Camera("1", 2704, 2028, np.array([[1400.0, 0, 1352], [0, 1400, 1014], [0, 0, 1]]), np.eye(4))
    assert _absurd(camera) == ""
    assert _absurd(camera.cropped(2500, 1900, 150, 100)) == ""


@pytest.mark.parametrize(
    "name",
    [
        "ims/1/000002.png",
        "seg/6/000001.png",
        "scene.json",
        "init_pt_cld.npz",
        "truth/particles.npz",
        "container_mask/1.png",
    ],
)
def test_what_is_no_plain_file_is_one_line_and_not_waited_for(name: str, balls_copy: Path) -> None:
    (balls_copy / name).parent.mkdir(exist_ok=True)
    (balls_copy / name).unlink(missing_ok=True)
    if name == "truth/particles.npz":
        (balls_copy / name).symlink_to("/proc/kmsg")
    else:
        os.mkfifo(balls_copy / name)
    assert any(name in fault for fault in check_scene(balls_copy))


def test_a_gravity_that_overflows_is_no_unit_vector() -> None:
    with pytest.raises(ValidationError, match="gravity"), np.errstate(all="raise"):
        SceneMeta(name="a", times=[0.0, 1.0], gravity=(1e200, 1e200, 0.0))
