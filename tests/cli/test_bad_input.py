"""Hostile and clumsy input: one line that names the file and the remedy, exit 1, and nothing half-written left."""

from __future__ import annotations

import json
import os
import shutil
import signal
import struct
import subprocess
import sys
import time
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from splashbench import toml
from splashbench.cli.main import main
from splashbench.files import files_together
from splashbench.harness.runner import run_method
from splashbench.submission import Submission, seal
from splashbench.synth.recording.video import write_recording

METHODS = Path(__file__).parents[1] / "harness" / "example_methods.py"
GOOD = f"import sys\nsys.path.insert(0, {str(METHODS.parent)!r})\nfrom example_methods import Good\n"
# As large as a disk that is nearly full: every file beyond it fails with EFBIG (Python ignores SIGXFSZ).
DISK_OF = (
    # Python would cache half a module, and load it from then on.
    "import resource, sys; sys.dont_write_bytecode = True; resource.setrlimit(resource.RLIMIT_FSIZE, ({0}, {0})); "
    "from splashbench.cli.main import main; sys.exit(main(sys.argv[1:]))"
)

Fails = Callable[..., str]


@pytest.fixture
def fails(capsys: pytest.CaptureFixture[str]) -> Fails:
    """Run a command that must fail; returns its one error line, after checking that it is one, and the last."""

    def run(*words: object) -> str:
        capsys.readouterr()
        assert main([str(word) for word in words]) == 1
        captured = capsys.readouterr()
        lines = captured.err.splitlines()
        assert [line for line in lines if line.startswith("error: ")] == lines[-1:]
        assert "Traceback" not in captured.err
        assert lines[-1].isprintable()
        return lines[-1]

    return run


@pytest.fixture(scope="module")
def truth(balls_directory: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The oracle's submission of the balls; not to be changed."""
    directory = tmp_path_factory.mktemp("submissions") / "oracle"
    run_method("oracle", balls_directory, directory)
    return directory


@pytest.fixture
def submission(truth: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(truth, tmp_path / "oracle"))


def reseal(directory: Path, **record: object) -> None:
    """Make the digests hold again after damage, as a forger would."""
    opened = Submission.open(directory, verify=False)
    seal(directory, opened.identity, opened.record)
    if record:
        path = directory / "record.json"
        path.write_text(json.dumps(json.loads(path.read_text()) | record))
        sums = directory / "SHA256SUMS"
        sums.write_text("".join(line for line in sums.read_text().splitlines(True) if "record.json" not in line))
        from splashbench.files import sha256_file

        sums.write_text(sums.read_text() + f"{sha256_file(path)}  record.json\n")


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


# --- scenes ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "damage", "said"),
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
        ("scene.json", lambda p: edit(p, lambda d: d.update(container_pose=[[1], [1, 2]])), "must be 4x4"),
        ("scene.json", lambda p: edit(p, lambda d: d["sizes"].update({"1": [65536, 65536]})), "sizes: camera 1"),
        ("scene.json", lambda p: edit(p, lambda d: d["sizes"].update({"one": [96, 64]})), "names camera one"),
        ("init_pt_cld.npz", lambda p: np.savez(p, data=np.array([[object()]])), "without pickles"),
        ("init_pt_cld.npz", lambda p: p.write_bytes(b""), "not a readable .npz"),
    ],
)
def test_a_damaged_file_of_a_scene_is_named(
    balls_copy: Path, fails: Fails, name: str, damage: Callable[[Path], object], said: str
) -> None:
    damage(balls_copy / name)
    for action in ("info", "check"):
        line = fails("scene", action, balls_copy)
        assert name in line
        assert said in line


def test_a_mask_of_the_wrong_size_ends_scoring_without_a_result(
    balls_copy: Path, submission: Path, tmp_path: Path, fails: Fails
) -> None:
    Image.new("L", (10, 20)).save(balls_copy / "seg" / "6" / "000002.png")
    assert "seg/6/000002.png is 10x20" in fails("scene", "check", balls_copy)
    # The forged submission says it is of the damaged scene.
    text = (submission / "submission.toml").read_text()
    from splashbench.scene import Scene

    digest = Submission.open(submission).identity.scene_digest
    (submission / "submission.toml").write_text(text.replace(digest, Scene.open(balls_copy).digest))
    reseal(submission)
    assert "seg/6/000002.png" in fails("score", submission, "--scene", balls_copy, "--out", tmp_path / "results")
    assert not (tmp_path / "results").exists()


def test_a_missing_camera_is_named(balls_copy: Path, tmp_path: Path, fails: Fails) -> None:
    shutil.rmtree(balls_copy / "ims" / "2")
    assert "ims/2/000000.png is missing" in fails("run", "oracle", balls_copy, tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("damage", "said"),
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
    balls_copy: Path, fails: Fails, damage: Callable[[Path], object], said: str
) -> None:
    damage(balls_copy / "ims" / "3" / "000002.png")
    line = fails("scene", "check", balls_copy)
    assert "ims/3/000002.png" in line
    assert said in line


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


# --- submissions and results ----------------------------------------------------------------------------------------


def test_a_thousand_missing_files_are_one_line_in_score_and_all_in_check(
    balls_directory: Path, submission: Path, tmp_path: Path, fails: Fails, capsys: pytest.CaptureFixture[str]
) -> None:
    with (submission / "SHA256SUMS").open("a") as sums:
        sums.writelines(f"{'0' * 64}  renders/8/{t:06d}.png\n" for t in range(1000))
    line = fails("score", submission, "--scene", balls_directory, "--out", tmp_path / "results")
    assert "renders/8/000000.png is missing (and 999 more)" in line
    assert not (tmp_path / "results").exists()
    assert main(["check", str(submission), "--scene", str(balls_directory)]) == 1
    assert capsys.readouterr().err.count("is missing") == 1000


@pytest.mark.parametrize(
    ("name", "damage", "said"),
    [
        ("submission.toml", lambda p: p.write_bytes(b"\xff\xfe"), "cannot be read as TOML"),
        ("submission.toml", lambda p: p.write_text("a = " + "[" * 100_000), "cannot be read as TOML"),
        ("submission.toml", lambda p: p.write_text(p.read_text().replace('"oracle"', '"../../x"')), "method: "),
        ("record.json", lambda p: edit(p, lambda d: d.update(fit_seconds=float("inf"))), "fit_seconds: "),
        ("record.json", lambda p: edit(p, lambda d: d.update(peak_memory_bytes=10**400)), "peak_memory_bytes: "),
        ("record.json", lambda p: edit(p, lambda d: d.update(status="great")), "status: "),
    ],
)
def test_a_forged_description_is_named(
    submission: Path, fails: Fails, name: str, damage: Callable[[Path], object], said: str
) -> None:
    damage(submission / name)
    line = fails("check", submission)
    assert name in line
    assert said in line


def test_particles_beyond_float32_are_refused(
    balls_directory: Path, submission: Path, tmp_path: Path, fails: Fails
) -> None:
    np.savez(submission / "particles.npz", positions=np.full((8, 2, 3), 1e300), active=np.ones((8, 2), bool))
    reseal(submission)
    assert "particles.npz: positions has entries beyond" in fails("check", submission)
    line = fails("score", submission, "--scene", balls_directory, "--out", tmp_path / "results")
    assert "particles.npz" in line
    assert not (tmp_path / "results").exists()


def test_a_strangers_reason_stays_on_one_line_and_off_the_terminal(
    balls_directory: Path, submission: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for folder in ("renders", "alpha"):
        shutil.rmtree(submission / folder)
    reseal(submission, status="crashed", reason="first\nsecond \x1b[31m")
    reseal(submission)
    words = ["score", submission, "--scene", balls_directory, "--out", tmp_path / "results"]
    assert main([str(word) for word in words]) == 0
    said = capsys.readouterr().err
    assert "first second ?[31m" in said
    assert "\x1b" not in said


@pytest.mark.parametrize(
    "change",
    ["x", "=1", "psnr_cap_db=inf", "psnr_cap_db=nan", "grid_cells=999999999", "ssim_sigma=1e308", "nothing=1"],
)
def test_a_bad_setting_of_the_protocol_is_named(
    balls_directory: Path, submission: Path, tmp_path: Path, fails: Fails, change: str
) -> None:
    words = ["score", submission, "--scene", balls_directory, "--out", tmp_path / "results", "--set", change]
    assert "--set" in fails(*words)
    assert not (tmp_path / "results").exists()


def test_a_view_smaller_than_the_window_is_named(
    balls_directory: Path, submission: Path, tmp_path: Path, fails: Fails
) -> None:
    words = ["score", submission, "--scene", balls_directory, "--out", tmp_path / "results", "--set", "ssim_sigma=50"]
    line = fails(*words)
    assert "ims/6/" in line
    assert "SSIM needs images of more than" in line


@pytest.fixture(scope="module")
def results(truth: Path, balls_directory: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the oracle's result."""
    directory = tmp_path_factory.mktemp("scored") / "results"
    assert main(["score", str(truth), "--scene", str(balls_directory), "--out", str(directory)]) == 0
    return directory


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (lambda p: p.write_bytes(b""), "cannot be read as JSON"),
        (lambda p: p.write_bytes(b"\xff"), "cannot be read as JSON"),
        (lambda p: (p.unlink(), p.mkdir()), "is a folder"),
        (lambda p: edit(p, lambda d: d.pop("digests")), "digests: Field required"),
        (lambda p: edit(p, lambda d: d["metrics"]["psnr"].update(value=float("nan"))), "metrics.psnr.value"),
        (lambda p: edit(p, lambda d: d["metrics"]["psnr"].update(value=1e308)), "metrics.psnr is 1e+308"),
        (lambda p: edit(p, lambda d: d["protocol"].update(version="v2")), "protocol.version"),
    ],
)
def test_a_damaged_result_is_named_and_no_leaderboard_is_left(
    results: Path, tmp_path: Path, fails: Fails, damage: Callable[[Path], object], said: str
) -> None:
    copy = Path(shutil.copytree(results, tmp_path / "results"))
    (path,) = copy.glob("*.json")
    damage(path)
    line = fails("leaderboard", copy, tmp_path / "board")
    assert path.name in line
    assert said in line
    assert not (tmp_path / "board").exists()


def test_what_a_killed_process_left_is_no_result(results: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(results, tmp_path / "results"))
    (copy / ".tmp-01234567-runs").mkdir()
    (copy / ".tmp-01234567-runs" / "record.json").write_text("{")
    (copy / ".tmp-89abcdef-x.json").write_text("{")
    assert main(["leaderboard", str(copy), str(tmp_path / "board")]) == 0


def test_results_of_another_protocol_have_a_table_of_their_own(results: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(results, tmp_path / "results"))
    (path,) = copy.glob("*.json")
    shutil.copy(path, other := copy / "other.json")
    edit(other, lambda d: (d["protocol"].update(grid_cells=50), d["digests"].update(protocol="1" * 64)))
    assert main(["leaderboard", str(copy), str(tmp_path / "board")]) == 0
    rows = (tmp_path / "board" / "leaderboard.csv").read_text().splitlines()
    assert len(rows) == 3
    assert sum("v1+" in row for row in rows) == 1


def test_files_appear_together_or_not_at_all(tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "mine").write_text("kept")
    with pytest.raises(ValueError), files_together(tmp_path / "out") as staging:
        (staging / "first").write_text("half")
        raise ValueError
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["mine"]
    with files_together(tmp_path / "out") as staging:
        (staging / "first").write_text("whole")
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["first", "mine"]
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


# --- methods and runs -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("source", "said"),
    [
        ("def broken(:\n", "SyntaxError"),
        ("\0\0", "cannot be imported"),
        ("import sys\nsys.exit(0)\n", "SystemExit"),
        ("M = 3\n", "subclass it"),
        ("", "has no class 'M'"),
        (GOOD + "class M(Good):\n    def __init__(self): raise ValueError('no licence')\n", "ValueError: no licence"),
        (GOOD + "class M(Good):\n    id = '../../x'\n", "method: String should match"),
        (GOOD + "class M(Good):\n    version = 2\n", "method_version: Input should be a valid string"),
        (GOOD + "class M(Good):\n    Config = 5\n", "no MethodConfig"),
    ],
)
def test_an_unusable_method_is_told_before_anything_runs(
    balls_directory: Path, tmp_path: Path, fails: Fails, source: str, said: str
) -> None:
    (tmp_path / "m.py").write_text(source)
    line = fails("run", f"{tmp_path / 'm.py'}:M", balls_directory, tmp_path / "out")
    assert said in line
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    "options",
    [
        ["--preset", "fastest"],
        ["--set", "blue"],
        ["--set", "blue=NaN"],
        ["--set", "blue=1e999"],
        ["--set", "blue=[1]"],
        ["--set", "blue=" + "[" * 100_000],
        ["--set", "blue=1", "--set", "blue.dark=2"],
    ],
    ids=lambda options: " ".join(options)[:30],
)
def test_a_bad_setting_is_told_before_anything_runs(
    balls_directory: Path, tmp_path: Path, fails: Fails, options: list[str]
) -> None:
    fails("run", f"{METHODS}:Good", balls_directory, tmp_path / "out", *options)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "words",
    [
        ["run", "nothing", "SCENE", "OUT", "--timeout", "nan"],
        ["run", "nothing", "SCENE", "OUT", "--seed", "-1"],
        ["prepare", "SESSION", "OUT", "--timesteps", "1000000000"],
        ["synth", "scene", "balls", "OUT", "--size", "0x0"],
        ["synth", "scene", "balls", "OUT", "--size", "99999x99999"],
        ["synth", "scene", "balls", "OUT", "--seed", "-1"],
        ["synth", "session", "OUT", "--workers", "0"],
        ["demo", "OUT", "--seed", "-1"],
    ],
    ids=" ".join,
)
def test_impossible_numbers_are_wrong_usage(words: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as stop:
        main(words)
    assert stop.value.code == 2
    assert list(tmp_path.iterdir()) == []


def test_binary_garbage_in_the_log_is_one_printable_line(balls_directory: Path, tmp_path: Path, fails: Fails) -> None:
    body = "import os\nclass M(Good):\n    def fit(self, scene, config, run):\n"
    body += "        os.write(1, bytes(range(256)) * 99)\n        os._exit(3)\n"
    (tmp_path / "m.py").write_text(GOOD + body)
    line = fails("run", f"{tmp_path / 'm.py'}:M", balls_directory, tmp_path / "out")
    assert "exit code 3" in line
    assert Submission.open(tmp_path / "out").status == "crashed"


@pytest.mark.parametrize("damage", ["path.write_bytes(b'x')", "__import__('shutil').rmtree(path.resolve().parents[2])"])
def test_a_method_that_changes_the_scene_is_found_out(
    balls_copy: Path, tmp_path: Path, fails: Fails, damage: str
) -> None:
    body = "class M(Good):\n    def fit(self, scene, config, run):\n"
    body += f"        path = scene.directory / 'ims' / '1' / '000000.png'\n        {damage}\n"
    body += "        return super().fit(scene, config, run)\n"
    (tmp_path / "m.py").write_text(GOOD + body)
    line = fails("run", f"{tmp_path / 'm.py'}:M", balls_copy, tmp_path / "out", "--timing-frames", "0")
    assert f"{balls_copy} was changed while good ran" in line
    assert not (tmp_path / "out").exists()


# --- places ---------------------------------------------------------------------------------------------------------


def test_replace_never_takes_an_input_or_a_strangers_folder(balls_copy: Path, tmp_path: Path, fails: Fails) -> None:
    mine = tmp_path / "photos"
    mine.mkdir()
    (mine / "holiday.jpg").write_bytes(b"dear")
    run = ["run", "oracle", balls_copy]
    assert f"{balls_copy} holds the input" in fails(*run, balls_copy, "--replace")
    assert f"{tmp_path} holds the input" in fails(*run, tmp_path, "--replace")
    assert "it has no submission.toml" in fails(*run, mine, "--replace")
    assert "holiday.jpg is a file" in fails(*run, mine / "holiday.jpg", "--replace")
    assert "it has no train_meta.json" in fails("synth", "scene", "balls", mine, "--replace")
    assert "not the demo's" in fails("demo", mine, "--fresh")
    assert (mine / "holiday.jpg").read_bytes() == b"dear"
    assert (balls_copy / "train_meta.json").is_file()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["balls", "photos"]


def test_a_session_is_never_replaced_by_its_scene(session: Path, fails: Fails) -> None:
    for place in (session, session.parent):
        assert f"{place} holds the input" in fails("prepare", session, place, "--replace")
    assert (session / "session.toml").is_file()


def test_a_link_stays_and_its_target_is_replaced(balls_directory: Path, tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to(tmp_path / "target")
    for _ in range(2):
        assert main(["run", "oracle", str(balls_directory), str(tmp_path / "link"), "--replace"]) == 0
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "target" / "submission.toml").is_file()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["link", "target"]


def test_a_place_that_cannot_be_is_told_before_the_work(
    balls_directory: Path, submission: Path, results: Path, tmp_path: Path, fails: Fails
) -> None:
    (tmp_path / "file").write_text("mine")
    scored = ["score", submission, "--scene", balls_directory]
    for place in (tmp_path / "file", tmp_path / "file" / "below"):
        assert f"{tmp_path / 'file'} is a file" in fails(*scored, "--out", place)
        assert f"{tmp_path / 'file'} is a file" in fails("leaderboard", results, place)
        assert str(place) in fails("run", "oracle", balls_directory, place)
    assert f"{submission} is a folder" in fails(*scored, "--out", tmp_path / "results", "--sheet", submission)
    assert not (tmp_path / "results").exists()
    assert (tmp_path / "file").read_text() == "mine"


def test_a_read_only_folder_is_told_before_the_work(
    balls_directory: Path,
    submission: Path,
    results: Path,
    tmp_path: Path,
    fails: Fails,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    (locked := tmp_path / "locked").mkdir()
    # Root, as which tests often run, may write everywhere.
    monkeypatch.setattr("splashbench.files.os.access", lambda path, mode: Path(path) != locked)
    scored = ["score", submission, "--scene", balls_directory]
    assert f"{locked} may not be written" in fails(*scored, "--out", locked / "results")
    assert f"{locked} may not be written" in fails("leaderboard", results, locked / "board")
    assert f"{locked} may not be written" in fails("run", "oracle", balls_directory, locked / "out")
    assert f"{locked} may not be written" in fails("synth", "scene", "balls", locked / "balls")


def test_spaces_and_letters_of_any_script_in_paths(balls_directory: Path, tmp_path: Path) -> None:
    place = tmp_path / "ü ñ 日本"
    scene = Path(shutil.copytree(balls_directory, place / "the scene"))
    (scene / "scene.json").unlink()  # the folder's name is the scene's
    scene = scene.rename(place / "器 1")
    for words in (
        ["run", "oracle", scene, place / "o ut"],
        ["score", place / "o ut", "--scene", scene, "--out", place / "re sults", "--sheet", place / "shéet.png"],
        ["leaderboard", place / "re sults", place / "b oard"],
        ["scene", "info", scene],
    ):
        assert main([str(word) for word in words]) == 0


# --- a full disk, signals, closed streams ---------------------------------------------------------------------------


def command(*words: object, code: str | None = None) -> list[str]:
    start = [sys.executable, "-m", "splashbench"] if code is None else [sys.executable, "-c", code]
    return [*start, *map(str, words)]


@pytest.mark.parametrize("name", ["balls", "oracle", "method", "score", "leaderboard", "prepare"])
def test_a_full_disk_is_one_line_and_leaves_nothing(
    name: str, balls_directory: Path, truth: Path, results: Path, session: Path, tmp_path: Path
) -> None:
    out = tmp_path / "place" / "out"
    out.parent.mkdir()
    words: dict[str, list[object]] = {
        "balls": ["synth", "scene", "balls", out],
        "oracle": ["run", "oracle", balls_directory, out],
        "method": ["run", "hull_points", balls_directory, out, "--timing-frames", 0],
        "score": ["score", truth, "--scene", balls_directory, "--out", out],
        "leaderboard": ["leaderboard", results, out],
        "prepare": ["prepare", session, out],
    }
    code = DISK_OF.format(3000)
    if name == "prepare":  # the clips are no rig: what its stages write stands in for them
        code = (
            "from splashbench.prepare import pipeline; from splashbench.files import write_text; "
            "pipeline._Run.into = lambda self, made: write_text(made / 'train_meta.json', 'x' * 9999); " + code
        )
    done = subprocess.run(command(*words[name], code=code), capture_output=True, text=True, timeout=60)
    lines = done.stderr.splitlines()
    assert done.returncode == 1
    assert [line for line in lines if "error" in line] == lines[-1:]
    assert f"{out}" in lines[-1]
    assert "could not be written: the disk is full; free some space" in lines[-1]
    assert list(out.parent.iterdir()) == []


SLOW = (
    GOOD + "import os, time\nclass M(Good):\n    def fit(self, scene, config, run):\n"
    "        with open(os.environ['STARTED'] + '.part', 'w') as stream:\n            stream.write(str(os.getpid()))\n"
    "        os.rename(os.environ['STARTED'] + '.part', os.environ['STARTED'])\n        time.sleep(60)\n"
)


def is_alive(pid: int) -> bool:
    """Whether process `pid` still runs (one that is dead but not waited for does not)."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


@pytest.mark.skipif(sys.platform != "linux", reason="looks into /proc")
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGHUP, signal.SIGKILL])
def test_a_stopped_run_takes_its_method_along_and_can_be_run_again(
    number: signal.Signals, balls_directory: Path, tmp_path: Path
) -> None:
    (tmp_path / "m.py").write_text(SLOW)
    started, place = tmp_path / "started", tmp_path / "place"
    place.mkdir()
    process = subprocess.Popen(
        command("run", f"{tmp_path / 'm.py'}:M", balls_directory, place / "out"),
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"STARTED": str(started), "TMPDIR": str(tmp_path)},
        # A test run that was started in the background, or by nohup, ignores these, and so would this.
        preexec_fn=lambda: [signal.signal(each, signal.SIG_DFL) for each in (signal.SIGINT, signal.SIGHUP)],
    )
    for _ in range(300):
        if started.exists():
            break
        time.sleep(0.1)
    pid = int(started.read_text())
    assert is_alive(pid)
    process.send_signal(number)
    _, said = process.communicate(timeout=20)
    for _ in range(50):
        if not is_alive(pid):
            break
        time.sleep(0.1)
    assert not is_alive(pid)
    if number == signal.SIGKILL:
        assert [path.name.startswith(".tmp-") for path in place.iterdir()] == [True]
    else:
        assert process.returncode == 128 + number
        assert said.strip() == "interrupted; nothing half-written was left"
        assert list(place.iterdir()) == []
    assert main(["run", "oracle", str(balls_directory), str(place / "out")]) == 0


def test_two_runs_into_one_place_leave_one_whole_submission(balls_directory: Path, tmp_path: Path) -> None:
    words = command("run", f"{METHODS}:Good", balls_directory, tmp_path / "out", "--timing-frames", 0)
    both = [subprocess.Popen(words, stderr=subprocess.PIPE, text=True) for _ in range(2)]
    said = {process.communicate(timeout=60)[1].split(":")[0]: process.returncode for process in both}
    assert said == {"good": 0, "error": 1}
    assert Submission.open(tmp_path / "out").status == "ok"
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


@pytest.mark.parametrize(
    ("redirection", "status", "said"),
    [
        (">&-", 0, ""),
        (">&- 2>&-", 0, ""),
        ("> /dev/full", 1, "error: standard output"),
        ("| :", 141, ""),
    ],
)
def test_a_closed_or_full_standard_output_is_no_traceback(
    balls_directory: Path, redirection: str, status: int, said: str
) -> None:
    if redirection == "> /dev/full" and not Path("/dev/full").exists():
        pytest.skip("needs /dev/full")
    line = f"set -o pipefail; '{sys.executable}' -m splashbench scene info '{balls_directory}' {redirection}"
    done = subprocess.run(["bash", "-c", line], capture_output=True, text=True, timeout=60)
    assert done.returncode == status
    assert done.stderr.startswith(said)
    assert len(done.stderr.splitlines()) == bool(said)


# --- sessions -------------------------------------------------------------------------------------------------------


def clip(path: Path) -> None:
    rng = np.random.default_rng(7)
    frames = (rng.integers(0, 255, (36, 64, 3), dtype=np.uint8) for _ in range(20))
    write_recording(path, frames, 20, (0.1 * rng.standard_normal(48_000)).astype(np.float32))


def silent_clip(path: Path) -> None:
    import av

    with av.open(str(path), "w", format="mp4") as container:
        stream = container.add_stream("libx264", rate=20)
        stream.width, stream.height, stream.pix_fmt = 64, 36, "yuv420p"
        for _ in range(20):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(np.zeros((36, 64, 3), np.uint8), format="rgb24")))
        container.mux(stream.encode(None))


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A session whose files can be read; noise has been filmed."""
    directory = tmp_path_factory.mktemp("recorded") / "session"
    for camera in ("1", "2", "3"):
        clip(directory / f"{camera}.MP4")
    chapters = {camera: [f"{camera}.MP4"] for camera in ("1", "2", "3")}
    description = {
        "schema_version": 1,
        "name": "noise",
        "cameras": ["1", "2", "3"],
        "train": ["1", "2"],
        "test": ["3"],
        "board": {"squares_x": 8, "squares_y": 5, "square_metres": 0.03, "marker_metres": 0.02}
        | {"dictionary": "DICT_4X4_50"},
        "recordings": dict.fromkeys(("pour", "static", "intrinsics"), chapters),
    }
    (directory / "session.toml").write_text(toml.dumps(description))
    return directory


@pytest.fixture
def session(recorded: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(recorded, tmp_path / "recordings" / "session"))


def rewrite(session: Path, old: str, new: str) -> None:
    text = (session / "session.toml").read_text()
    assert old in text
    (session / "session.toml").write_text(text.replace(old, new, 1))


POUR_2 = '2 = [\n    "2.MP4",\n]'


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (lambda s: silent_clip(s / "2.MP4"), "2.MP4 has no audio track"),
        (lambda s: (s / "2.MP4").write_bytes((s / "2.MP4").read_bytes()[:9000]), "2.MP4 is damaged, cut short"),
        (lambda s: (s / "2.MP4").write_bytes(b""), "2.MP4 is damaged, cut short"),
        (lambda s: (s / "2.MP4").write_text("#EXTM3U\nfile:///etc/passwd\n"), "2.MP4 is damaged, cut short"),
        (lambda s: (s / "2.MP4").unlink(), "2.MP4 (the pour recording of camera 2) does not exist"),
        (lambda s: ((s / "2.MP4").unlink(), (s / "2.MP4").mkdir()), "2.MP4 (the pour recording of camera 2)"),
        (lambda s: ((s / "2.MP4").unlink(), (s / "2.MP4").symlink_to(sys.executable)), "lies outside the session"),
        (lambda s: rewrite(s, '"2.MP4"', '"../../../x.MP4"'), "lies outside the session"),
        (lambda s: rewrite(s, '"2.MP4"', '"/etc/passwd"'), "lies outside the session"),
        (lambda s: rewrite(s, '"2.MP4"', '"1.MP4"'), "1.MP4 is listed twice in [recordings.pour]"),
        (lambda s: rewrite(s, '"2.MP4"', '"\\u0000"'), "unusable name"),
        (lambda s: rewrite(s, POUR_2, ""), "camera 2 has no entry in [recordings.pour]"),
        (lambda s: rewrite(s, "square_metres = 0.03", "square_metres = nan"), "board.square_metres"),
        (lambda s: rewrite(s, "squares_x = 8", "squares_x = -8"), "board.squares_x"),
        (lambda s: (s / "session.toml").write_bytes(b'name = "\xff"'), "session.toml cannot be read as TOML"),
        (lambda s: (s / "session.toml").write_text("a = " + "[" * 100_000), "session.toml cannot be read as TOML"),
        (lambda s: ((s / "session.toml").unlink(), (s / "session.toml").mkdir()), "session.toml is a folder"),
    ],
)
def test_an_unusable_session_is_one_line_and_no_scene(
    session: Path, tmp_path: Path, fails: Fails, damage: Callable[[Path], object], said: str
) -> None:
    damage(session)
    line = fails("prepare", session, tmp_path / "scenes" / "scene")
    assert said in line
    assert not (tmp_path / "scenes").exists() or list((tmp_path / "scenes").iterdir()) == []


@pytest.mark.parametrize("options", [["--interval", "0", "inf"], ["--interval", "2", "1"], ["--masks", "nowhere"]])
def test_bad_options_of_prepare_are_told_before_the_work(
    session: Path, tmp_path: Path, fails: Fails, options: list[str]
) -> None:
    assert options[-1] in fails("prepare", session, tmp_path / "scene", *options)
    assert not (tmp_path / "scene").exists()


def test_a_truth_of_the_wrong_shape_is_named(session: Path, balls_directory: Path, fails: Fails) -> None:
    (session / "truth").mkdir()
    for text in ("", "[]", "{}", '{"schema_version": 1}', "\0"):
        (session / "truth" / "truth.json").write_text(text)
        assert "truth.json" in fails("synth", "verify", session, balls_directory)
