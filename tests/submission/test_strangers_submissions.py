"""Submissions from strangers: one line says what is wrong with each file, and `check` says what `score` would."""

from __future__ import annotations

import os
import re
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from pydantic import ValidationError

from splashbench.cli.main import main
from splashbench.errors import SplashbenchError
from splashbench.files.png import png_of
from splashbench.scene import Particles, Scene
from splashbench.submission import Identity, Record, Submission, check_submission, seal

VIEW = "renders/6/000003.png"
pytestmark = pytest.mark.usefixtures("no_hang")


def reseal(directory: Path) -> None:
    submission = Submission.open(directory, verify=False)
    seal(directory, submission.identity, submission.record)


def run(*words: object) -> int:
    return main([str(word) for word in words])


def refused(copy: Path, balls: Scene, tmp_path: Path, capsys: pytest.CaptureFixture[str], *options: str) -> list[str]:
    """The lines by which `check` refuses the submission, after asking that `score` does as well, in one line."""
    capsys.readouterr()
    assert run("score", copy, "--scene", balls.directory, "--out", tmp_path / "results") == 1
    lines = capsys.readouterr().err.splitlines()
    assert lines[-1].startswith("error: ")
    assert not (tmp_path / "results").exists()
    assert run("check", copy, "--scene", balls.directory, *options) == 1
    lines = capsys.readouterr().err.splitlines()
    assert all(line.startswith("error: ") for line in lines)
    return lines


def _cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:200])


def _as(mode: str, form: str = "PNG") -> Callable[[Path], None]:
    def convert(path: Path) -> None:
        with Image.open(path) as image:
            image.convert(mode).save(path, format=form)

    return convert


def _sixteen(path: Path) -> None:
    import cv2

    assert cv2.imwrite(str(path), np.zeros((64, 96, 3), np.uint16))


@pytest.mark.parametrize(
    ("name", "change", "said"),
    [
        (VIEW, _cut, "cut short"),
        (VIEW, _as("RGBA"), "RGB with alpha"),
        (VIEW, _as("L"), "grey of 8"),
        (VIEW, _as("P"), "palette"),
        (VIEW, _as("RGB", "JPEG"), "no PNG"),
        (VIEW, _sixteen, "of 16 bits"),
        ("alpha/6/000003.png", _as("RGB"), "RGB of 8"),
        ("alpha/6/000003.png", _as("LA"), "grey with alpha"),
        ("alpha/6/000003.png", _as("1"), "grey of 1"),
    ],
)
def test_check_refuses_an_image_as_score_does(
    name: str,
    change: Callable[[Path], None],
    said: str,
    copy: Path,
    balls: Scene,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    change(copy / name)
    reseal(copy)
    (line,) = refused(copy, balls, tmp_path, capsys)
    assert name in line
    assert said in line


def test_check_finds_forged_pixels_when_asked_to_unpack_them(
    copy: Path, balls: Scene, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    header = struct.pack(">IIBBBBB", 96, 64, 8, 2, 0, 0, 0)
    pixels = zlib.compress(bytes(100)) + bytes(100)
    (copy / VIEW).write_bytes(png_of([(b"IHDR", header), (b"IDAT", pixels), (b"IEND", b"")]))
    reseal(copy)
    (line,) = refused(copy, balls, tmp_path, capsys, "--pixels")
    assert VIEW in line


def _sparse(path: Path) -> None:
    with path.open("wb") as stream:
        stream.truncate(1 << 40)


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (os.mkfifo, "is a device or pipe"),
        (_sparse, "has more than 16 GiB"),
        (lambda path: path.symlink_to("/proc/kmsg"), "is a link"),
        (lambda path: path.symlink_to("/dev/zero"), "is a link"),
    ],
    ids=["pipe", "terabyte", "link to the kernel", "link to a device"],
)
@pytest.mark.parametrize(
    "name", [VIEW, "particles.npz", "record.json", "SHA256SUMS", "submission.toml", "model/extra", "geometry.npz"]
)
def test_what_is_no_plain_file_ends_in_one_line(
    name: str,
    make: Callable[[Path], None],
    said: str,
    copy: Path,
    balls: Scene,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    (copy / "model").mkdir(exist_ok=True)
    (copy / name).unlink(missing_ok=True)
    make(copy / name)
    lines = refused(copy, balls, tmp_path, capsys)
    assert any(name in line or said in line for line in lines)


def test_what_a_method_saved_is_not_waited_for(copy: Path) -> None:
    (copy / "model").mkdir(exist_ok=True)
    os.mkfifo(copy / "model" / "weights")
    with pytest.raises(SplashbenchError, match="model/weights is a device or pipe"):
        reseal(copy)


@pytest.mark.parametrize(("name", "said"), [(b"\xff", "no UTF-8"), (b"a\nb", "line break")])
def test_a_name_that_no_list_of_sums_can_hold_is_one_line(
    name: bytes, said: str, copy: Path, balls: Scene, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    Path(os.fsdecode(os.fsencode(copy) + b"/" + name)).write_bytes(b"more")
    with pytest.raises(SplashbenchError, match=said):
        reseal(copy)
    (line,) = refused(copy, balls, tmp_path, capsys)
    assert said in line
    assert line.isprintable()


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ("a = " + "[" * 300 + "]" * 300, "within each other"),
        (".".join(["a"] * 300) + " = 1", "key of more than 32 parts"),
        ("a = 1979-05-27T07:32:00Z", "a is a datetime"),
        ("a.b = [07:32:00]", "a.b is a time"),
        ("a = nan", "a is nan"),
        ("a = [[-inf]]", "a is -inf"),
        ("a = " + "9" * 400, "more than 64 bits"),
    ],
)
def test_settings_that_are_no_json_are_refused_by_check_and_score(
    settings: str, said: str, copy: Path, balls: Scene, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = copy / "submission.toml"
    text = path.read_text().replace("[settings]", "")
    path.write_text(text + f"\n[settings]\n{settings}\n")
    (line,) = refused(copy, balls, tmp_path, capsys)
    assert "submission.toml" in line
    assert said in line


@pytest.mark.parametrize(
    ("entry", "said"),
    [
        ('"reason": "\\ud800"', "surrogate"),
        ('"stages": {"\\ud800": 1}', "surrogate"),
        ('"storage_bytes": 1e308', "storage_bytes"),
        ('"timed_frames": 1' + "0" * 400, "timed_frames"),
        ('"notes": ' + '{"a":' * 100 + "1" + "}" * 100, "within each other"),
    ],
)
def test_a_record_that_no_result_could_hold_is_refused(
    entry: str, said: str, copy: Path, balls: Scene, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (copy / "record.json").write_text('{"status": "ok", ' + entry + "}")
    (line,) = refused(copy, balls, tmp_path, capsys)
    assert "record.json" in line
    assert said in line


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ('preset = "' + "a" * 201 + '"', "preset"),
        ('method_version = "1\\u001b[31m"', "method_version: it has control characters"),
        ("claimed = {" + ", ".join(f"c{n} = 1.0" for n in range(1001)) + "}", "claimed"),
    ],
)
def test_what_no_result_may_say_is_refused_before_it_is_scored(
    line: str, said: str, copy: Path, balls: Scene, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = copy / "submission.toml"
    path.write_text(line + "\n" + re.sub(rf"(?m)^{line.split()[0]} = .*\n|^\[claimed\]\n", "", path.read_text()))
    (fault,) = refused(copy, balls, tmp_path, capsys)
    assert f"submission.toml: {said}" in fault


def test_a_seed_is_a_number_of_64_bits() -> None:
    for seed in (10**20, -(10**20)):
        with pytest.raises(ValidationError):
            Identity(method="a", scene="b", scene_digest="0" * 64, seed=seed)


def test_sums_of_two_files_of_one_name_and_of_any_length_are_refused(
    copy: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sums = copy / "SHA256SUMS"
    text = sums.read_text()
    sums.write_text(text + text.splitlines()[0] + "\n")
    assert "twice" in check_submission(copy)[0]
    sums.write_text(text.replace("\n", "\r\n"))  # as an editor on another system leaves it
    assert check_submission(copy) == []
    monkeypatch.setattr("splashbench.submission.submission._MAX_SUMS_BYTES", 100)
    assert "is larger than 100 bytes" in check_submission(copy)[0]


def test_particles_that_unpack_to_gigabytes_are_refused_unread(copy: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import zipfile

    n = (1 << 30) // 4 // 8 // 3  # positions alone are as many bytes as are allowed
    header = f"{{'descr': '<f4', 'fortran_order': False, 'shape': (8, {n}, 3), }}\n".encode()
    with zipfile.ZipFile(copy / "particles.npz", "w", zipfile.ZIP_STORED) as archive:
        archive.writestr("positions.npy", b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header)
        for name in ("active", "velocities"):
            archive.writestr(f"{name}.npy", bytes(10))
    # The sizes are the archive's to claim: here it claims those that its headers state.
    data = bytearray((copy / "particles.npz").read_bytes())
    place = data.find(b"PK\x01\x02") + 24
    data[place : place + 4] = struct.pack("<I", (1 << 30) + 1)
    (copy / "particles.npz").write_bytes(bytes(data))
    assert any("particles.npz unpacks to more than 1 GiB" in fault for fault in check_submission(copy))


def test_an_identity_that_was_written_can_be_read() -> None:
    settings = {"a": [1, 2.5, "b", True, {"c": []}], "d": {"e": "f"}}
    identity = Identity(method="a", scene="b", scene_digest="0" * 64, settings=settings, hardware={"cores": 2})
    assert Identity.model_validate_json(identity.model_dump_json()) == identity
    assert Record.model_validate_json(Record(timed_frames=100).model_dump_json()).timed_frames == 100


def test_more_particles_than_scoring_could_look_at_are_refused(copy: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("splashbench.scene.particles.MAX_PARTICLES", 100)
    Particles(np.zeros((8, 101, 3)), np.ones((8, 101), bool)).save(copy / "particles.npz")
    assert any("particles.npz has more than 100 particles" in fault for fault in check_submission(copy))
