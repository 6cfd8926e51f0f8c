"""Damaged, hostile and impossible scenes: one line that names the file and the remedy, exit status 1."""

from __future__ import annotations

import json
import os
import shutil
import struct
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from splashbench.cli.main import main

Fails = Callable[..., str]


#: A pose as libraries for the web write it, column by column.
TRANSPOSED = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0.2, 0.1, 0.5, 1]]


def edit(path: Path, change: Callable[[dict], object]) -> None:
    data = json.loads(path.read_text())
    change(data)
    path.write_text(json.dumps(data))


def giant_png(path: Path, side: int) -> None:
    """A few bytes that claim to be an image of `side` x `side` pixels."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", side, side, 8, 2, 0, 0, 0)
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IEND", b""))


@pytest.mark.parametrize(
    ("name", "damage", "message"),
    [
        ("train_meta.json", lambda p: p.write_bytes(b""), "cannot be read as JSON"),
        ("train_meta.json", lambda p: p.write_bytes(b'{"w": "\xff"}'), "cannot be read as JSON"),
        ("train_meta.json", lambda p: p.write_text("[1, 2]"), "valid dictionary"),
        ("train_meta.json", lambda p: p.write_text('{"w": ' + "9" * 5000 + "}"), "cannot be read as JSON"),
        ("train_meta.json", lambda p: edit(p, lambda d: d.update(w=-96)), "w: "),
        ("train_meta.json", lambda p: edit(p, lambda d: d["k"][0].pop()), "k is ragged"),
        ("train_meta.json", lambda p: edit(p, lambda d: d["k"][0][0][0].__setitem__(0, float("nan"))), "k has entries"),
        ("test_meta.json", lambda p: edit(p, lambda d: d["w2c"][0][0][0].__setitem__(3, 1e300)), "w2c has entries"),
        ("train_meta.json", lambda p: edit(p, lambda d: d["fn"][0].__setitem__(0, "../../x.png")), "fix the entry"),
        ("train_meta.json", lambda p: edit(p, lambda d: d["fn"][0].__setitem__(0, "/etc/x.png")), "fix the entry"),
        ("train_meta.json", lambda p: edit(p, lambda d: d["fn"].__setitem__(1, d["fn"][0])), "in two frames"),
        ("train_meta.json", lambda p: edit(p, lambda d: d["fn"][0].__setitem__(0, d["fn"][0][1])), "a camera twice"),
        ("scene.json", lambda p: (p.unlink(), p.mkdir()), "is a folder, not a file"),
        ("scene.json", lambda p: edit(p, lambda d: d["times"].__setitem__(1, float("nan"))), "times must be finite"),
        ("scene.json", lambda p: edit(p, lambda d: d["times"].__setitem__(-1, 1e308)), "times must be finite"),
        ("scene.json", lambda p: edit(p, lambda d: d.update(gravity=[float("nan")] * 3)), "unit vector"),
        ("scene.json", lambda p: edit(p, lambda d: d.update(metres_per_unit=1e-10)), "metres_per_unit"),
        ("scene.json", lambda p: edit(p, lambda d: d.update(metres_per_unit=1e10)), "metres_per_unit"),
        ("scene.json", lambda p: edit(p, lambda d: d.update(container_pose=[[1], [1, 2]])), "must be 4x4"),
        ("scene.json", lambda p: edit(p, lambda d: d.update(container_pose=TRANSPOSED)), "it may be transposed"),
        ("scene.json", lambda p: edit(p, lambda d: d["sizes"].update({"1": [65536, 65536]})), "sizes: camera 1"),
        ("scene.json", lambda p: edit(p, lambda d: d["sizes"].update({"one": [96, 64]})), "names camera one"),
        ("init_pt_cld.npz", lambda p: np.savez(p, data=np.array([[object()]])), "without pickles"),
        ("init_pt_cld.npz", lambda p: p.write_bytes(b""), "not a readable .npz"),
        ("init_pt_cld.npz", lambda p: np.savez(p, data=np.full((4, 7), 1e300)), "points lie beyond"),
        ("init_pt_cld.npz", lambda p: np.savez(p, data=np.full((4, 7), 200.0)), "divide them by 255"),
        (
            "scene.json",
            lambda p: edit(p, lambda d: d.update(camera_times={"6": [500 + t for t in d["times"]]})),
            "seconds of one clock",
        ),
        (
            "scene.json",
            lambda p: edit(p, lambda d: d.update(camera_times={"6": [1000 * t for t in d["times"]]})),
            "seconds of one clock",
        ),
    ],
)
def test_a_damaged_file_of_a_scene_is_named(
    balls_copy: Path, fails: Fails, name: str, damage: Callable[[Path], object], message: str
) -> None:
    damage(balls_copy / name)
    for action in ("info", "check"):
        line = fails("scene", action, balls_copy)
        assert name in line
        assert message in line


def test_a_missing_camera_is_named(balls_copy: Path, tmp_path: Path, fails: Fails) -> None:
    shutil.rmtree(balls_copy / "ims" / "2")
    assert "ims/2/000000.png is missing" in fails("run", "oracle", balls_copy, tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda p: giant_png(p, 60_000), "not a readable image"),
        (lambda p: giant_png(p, 11_000), "more than 67108864 pixels"),
        (lambda p: p.write_bytes(b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 96 64\nshowpage\n"), "not a readable"),
        (lambda p: Image.fromarray(np.zeros((64, 96), np.uint16)).save(p), "more than 8 bits"),
        (lambda p: p.write_bytes(p.read_bytes()[:60]), "cut short or damaged"),
        (lambda p: (p.unlink(), os.mkfifo(p)), "is a device or pipe"),
        (lambda p: (p.unlink(), p.mkdir()), "is a folder"),
    ],
    ids=["bomb", "too large", "postscript", "16 bits", "cut", "pipe", "folder"],
)
def test_an_unusable_image_is_named(
    balls_copy: Path, fails: Fails, damage: Callable[[Path], object], message: str
) -> None:
    damage(balls_copy / "ims" / "3" / "000002.png")
    line = fails("scene", "check", balls_copy)
    assert "ims/3/000002.png" in line
    assert message in line


@pytest.mark.parametrize("offset", [(6, 8, 1, 1), (8, 10, 99, 99)], ids=["encrypted", "unknown compression"])
def test_an_archive_that_cannot_be_unpacked_is_named(balls_copy: Path, fails: Fails, offset: tuple[int, ...]) -> None:
    path = balls_copy / "init_pt_cld.npz"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("data.npy", b"abc")
    data = bytearray(path.read_bytes())
    local, central, *values = offset
    data[local] = values[0]
    data[data.find(b"PK\x01\x02") + central] = values[1]
    path.write_bytes(bytes(data))
    assert "init_pt_cld.npz is not a readable .npz" in fails("scene", "check", balls_copy)


def test_an_array_larger_than_memory_is_refused(balls_copy: Path, fails: Fails) -> None:
    header = b"{'descr': '<f8', 'fortran_order': False, 'shape': (4000000000000000, 7)}\n"
    with zipfile.ZipFile(balls_copy / "init_pt_cld.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("data.npy", b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + bytes(10_000))
    assert "init_pt_cld.npz is not a readable .npz" in fails("scene", "check", balls_copy)


def test_a_transposed_pose_is_told_by_every_command(balls_copy: Path, tmp_path: Path, fails: Fails) -> None:
    def transpose(data: dict) -> None:
        data["w2c"] = [[np.transpose(pose).tolist() for pose in row] for row in data["w2c"]]

    edit(balls_copy / "train_meta.json", transpose)
    for words in (["scene", "check", balls_copy], ["run", "hull_points", balls_copy, tmp_path / "out"]):
        assert "w2c does not end in 0 0 0 1; it may be transposed" in fails(*words)
    assert not (tmp_path / "out").exists()


def test_a_camera_that_no_submission_can_name_is_told_before_the_fit(
    balls_copy: Path, tmp_path: Path, fails: Fails
) -> None:
    long = "c" * 124
    (balls_copy / "ims" / "2").rename(balls_copy / "ims" / long)
    (balls_copy / "seg" / "2").rename(balls_copy / "seg" / long)
    edit(
        balls_copy / "train_meta.json",
        lambda d: d.update(fn=[[n.replace("2/", f"{long}/", 1) if n[0] == "2" else n for n in r] for r in d["fn"]]),
    )
    edit(balls_copy / "scene.json", lambda d: d["sizes"].update({long: d["sizes"].pop("2")}))
    line = fails("run", "hull_points", balls_copy, tmp_path / "out")
    assert "a submission cannot say its cameras" in line
    assert not (tmp_path / "out").exists()


def test_a_file_of_a_name_that_is_no_text_ends_no_run(balls_copy: Path, tmp_path: Path) -> None:
    Path(os.fsdecode(bytes(balls_copy) + b"/n\xe9.json")).write_text("{}")
    assert main(["run", "hull_points", str(balls_copy), str(tmp_path / "out")]) == 0
    assert (tmp_path / "out" / "scene_files.json").is_file()


def test_test_views_without_masks_are_told_before_the_fit(
    balls_copy: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.rmtree(balls_copy / "seg" / "6")
    assert main(["run", "hull_points", str(balls_copy), str(tmp_path / "out")]) == 0
    assert "note: test views 6 have no masks, so that this run cannot be scored" in capsys.readouterr().err
