"""`splashbench download scenes --containers`: every scene gets its container's mesh, or a line that says why not.

By `--container-masks` crops get their masks."""

from __future__ import annotations

import json
import shlex
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from splashbench.cli.main import build_parser, main
from splashbench.container import scene_placement
from splashbench.download.containers import add_containers
from splashbench.download.scenes import SceneReport, download_scenes
from splashbench.errors import DiskFullError, SplashbenchError
from splashbench.files import list_files, sha256_file
from splashbench.scene import Scene
from splashbench.scene.container import read_mesh
from splashbench.scene.container_masks import _cut
from splashbench.synth.release import METRES_PER_UNIT, bowl_pose, imitations, write_release

from ..container.painted import write_painted_scene

NAMES = ["bowl_001", "bowl_002", "tank_002"]
CROP, FULL = "real_scene_crop", "real_scene"
# Scene units: what a pixel of the whole image covers at the bowl, about.
PIXEL = 0.015


@pytest.fixture(autouse=True)
def _own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SPLASHBENCH_CACHE", str(tmp_path / "cache"))


@pytest.fixture(scope="module")
def fetched(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two scanned bowls and a tank in both variants, as they are without containers; read-only."""
    place = tmp_path_factory.mktemp("release")
    write_release(place / "given.zip", [replace(scene, size=(96, 64), frames=2) for scene in imitations(NAMES)])
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SPLASHBENCH_CACHE", str(place / "cache"))
        download_scenes(place / "real", NAMES, ("full", "crop"), place / "given.zip", tell=lambda line: None)
    return place / "real"


@pytest.fixture(scope="module")
def placed(fetched: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same with containers: of one bowl in both variants, of the other in the crop; read-only."""
    out = copied(fetched, tmp_path_factory.mktemp("placed"))
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SPLASHBENCH_CACHE", str(out.parent / "cache"))
        assert main(command(out, "bowl_001")) == 0
        assert main(command(out, "bowl_002", "tank_002", variant=("crop",))) == 0
    return out


@pytest.fixture
def out(fetched: Path, tmp_path: Path) -> Path:
    """A copy without containers, which the test may damage."""
    return copied(fetched, tmp_path)


def copied(folder: Path, parent: Path) -> Path:
    return Path(shutil.copytree(folder, parent / "real"))


def command(out: Path, *names: str, variant: tuple[str, ...] = ("full", "crop")) -> list[str]:
    return ["download", "scenes", *(names or NAMES), str(out), "--variant", *variant, "--containers"]


def tree(folder: Path) -> dict[str, str]:
    """Every file's digest; locks aside."""
    return {name: sha256_file(folder / name) for name in list_files(folder).names if not name.endswith(".lock")}


def lines_about(text: str, scene: str) -> list[str]:
    """What is told of a scene's container when all is done."""
    return [line for line in text.splitlines() if line.startswith(("note:", "error:")) and scene in line]


def require_placed(scene: Scene) -> None:
    """The bowl stands where the imitation has it, and tells gravity and scale."""
    mesh = scene.container_mesh()
    assert mesh is not None
    assert scene.meta is not None
    true = read_mesh(scene.directory / str(scene.meta.container_mesh)).placed(bowl_pose())
    # A bowl may be turned about its axis at will: rim, foot and centre tell.
    np.testing.assert_allclose(mesh.vertices.min(axis=0), true.vertices.min(axis=0), atol=PIXEL)
    np.testing.assert_allclose(mesh.vertices.max(axis=0), true.vertices.max(axis=0), atol=PIXEL)
    assert scene.metres_per_unit == pytest.approx(METRES_PER_UNIT, rel=0.01)
    assert scene.gravity is not None
    assert np.degrees(np.arccos(-scene.gravity[1])) < 0.5


def test_scans_are_placed_in_both_variants_by_the_masks_of_the_full_one(fetched: Path, placed: Path) -> None:
    assert list(fetched.rglob("scene.json")) == []  # off by default
    assert not (placed / CROP / "bowl_001" / "container_mask").exists()
    noted = json.loads((placed / "scenes.json").read_text())["scenes"]
    for folder, name in ((FULL, "bowl_001"), (CROP, "bowl_001"), (CROP, "bowl_002")):
        scene = Scene.open(placed / folder / name)
        require_placed(scene)
        assert (scene.directory / "container.glb").read_bytes() == (placed / "meshes" / f"{name}.glb").read_bytes()
        assert {"gravity", "metric scale", "container mesh"} <= set(scene.stated)
        assert (scene.is_released, scene.times_source) == (True, "manifest")
        listing = list_files(scene.directory)
        assert noted[f"{folder}/{name}"] == {
            "files": len(listing.names),
            "bytes": listing.bytes,
            "faults": [],
            "container": "container.glb",
        }
    assert noted[f"{CROP}/tank_002"]["container"] is None
    assert list(placed.rglob(".tmp-*")) == []


def test_again_it_says_already_and_changes_no_byte(
    placed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = copied(placed, tmp_path)
    before, stamps = tree(out), {path: path.stat().st_mtime_ns for path in out.rglob("scene.json")}
    assert main([*command(out, variant=("crop",)), "--json"]) == 0
    said = capsys.readouterr()
    assert tree(out) == before
    assert {path: path.stat().st_mtime_ns for path in out.rglob("scene.json")} == stamps
    assert said.err.count("already container.glb") == 2
    assert "placing" not in said.err
    assert "checking" not in said.err
    assert "0 put in their places now, 2 that were there already, 1 missing" in said.err
    facts = json.loads(said.out)["containers"]
    assert [(each["file"], each["made"]) for each in facts] == [
        ("container.glb", False),
        ("container.glb", False),
        (None, False),
    ]


def test_a_tank_that_may_be_transparent_is_one_line_with_the_command_to_do_it_by_hand(
    out: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.rmtree(out / FULL / "tank_002")
    shutil.rmtree(out / FULL / "bowl_001")
    assert main(command(out, "tank_002", variant=("crop",))) == 0
    (line,) = lines_about(capsys.readouterr().err, "tank_002")
    assert line.startswith(f"note: no container in {CROP}/tank_002: there is no scan of it")
    words = shlex.split(line.partition("; by hand: ")[2])
    assert words[:4] == ["splashbench", "scene", "reconstruct-container", str(out / CROP / "tank_002")]
    assert build_parser().parse_args(words[1:]).masks == out / FULL / "tank_002"
    # What its owner knows goes before.
    (out / CROP / "tank_002" / "scene.json").write_text('{"name": "tank_002", "container_transparent": false}')
    assert main(command(out, "tank_002", variant=("crop",))) == 0
    (line,) = lines_about(capsys.readouterr().err, "tank_002")
    assert "is not unpacked: add --variant full crop" in line


@pytest.mark.slow
def test_stopped_and_killed_it_goes_on_and_ends_with_the_same_bytes(
    out: Path, placed: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    real, calls = scene_placement.place_in_scene, []
    words = command(out, variant=("crop",))

    def stopped(*words: object) -> object:
        calls.append(words)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return real(*words)  # type: ignore[arg-type]

    with monkeypatch.context() as patch:
        patch.setattr(scene_placement, "place_in_scene", stopped)
        assert main(words) == 130
    assert "the same command goes on" in capsys.readouterr().err
    assert [path.parent.name for path in out.rglob("scene.json")] == ["bowl_001"]
    assert list(out.rglob(".tmp-*")) == []
    # Killed while it writes beside the scene, and between the moves of mesh and scene.json.
    scan = out / "meshes" / "bowl_002.glb"
    (out / CROP / ".tmp-0a1b2c3d-bowl_002").mkdir()
    shutil.copyfile(scan, out / CROP / ".tmp-0a1b2c3d-bowl_002" / "container.glb")
    shutil.copyfile(scan, out / CROP / "bowl_002" / "container.glb")
    assert main(words) == 0
    assert tree(out / CROP) == tree(placed / CROP)
    assert list(out.rglob(".tmp-*")) == []


def damaged_scan(out: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (out / "meshes" / "bowl_001.glb").write_bytes(b"glTF and no more")


def another_scan(out: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    trimesh.creation.box((3, 0.05, 0.05)).export(out / "meshes" / "bowl_001.glb")


def no_masks(out: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shutil.rmtree(out / FULL / "bowl_001" / "container_mask")


def one_mask(out: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in "2345":
        (out / FULL / "bowl_001" / "container_mask" / f"{name}.png").unlink()


def damaged_mask(out: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (out / FULL / "bowl_001" / "container_mask" / "3.png").write_bytes(b"no picture")


def nothing_unpacked_whole(out: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shutil.rmtree(out / FULL / "bowl_001")


def read_only(out: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    locked = (out / CROP / "bowl_001").resolve()
    monkeypatch.setattr("splashbench.files.places.os.access", lambda path, mode: Path(path) != locked)


def somebodys_file(out: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (out / CROP / "bowl_001" / "container.glb").write_bytes(b"somebody's")


@pytest.mark.parametrize(
    ("damage", "reason"),
    [
        (damaged_scan, "bowl_001.glb is not a readable mesh"),
        (another_scan, "check that it is this container's"),
        (no_masks, "container_mask is not there; draw <camera>.png"),
        (one_mask, "two are needed"),
        (damaged_mask, "3.png"),
        (nothing_unpacked_whole, "is not unpacked: add --variant full crop"),
        (read_only, "bowl_001 may not be written"),
        (somebodys_file, "container.glb is there already"),
    ],
)
def test_what_is_in_the_way_of_one_scene_is_one_line_and_the_rest_goes_on(
    damage: Callable[[Path, pytest.MonkeyPatch], None],
    reason: str,
    out: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    damage(out, monkeypatch)
    before = tree(out / CROP / "bowl_001")
    others = ["bowl_002"] if damage is no_masks else []  # placing takes seconds: once will do
    assert main(command(out, "bowl_001", *others, variant=("crop",))) == 1
    said = capsys.readouterr().err
    lines = [line for line in said.splitlines() if line.startswith(("note:", "error:")) and reason in line]
    assert len(lines) == 1, said
    if damage is not damaged_scan:  # which is told as a fault of the scene
        assert lines[0].startswith(f"error: the scan is not placed in {CROP}/bowl_001: ")
        words = shlex.split(lines[0].partition("; by hand: ")[2])
        assert build_parser().parse_args(words[1:]).scene == out / CROP / "bowl_001"
    assert tree(out / CROP / "bowl_001") == before
    for name in others:
        assert lines_about(said, name) == []
        require_placed(Scene.open(out / CROP / name))
    assert list(out.rglob(".tmp-*")) == []


def test_a_folder_that_refuses_is_told_and_a_full_disk_ends_it(out: Path) -> None:
    class Refused:
        """A folder whose parent may not be written, which only shows when something is written."""

        error: Exception = PermissionError(13, "Permission denied", str(out / CROP))

        def place(self, scene: Path, scan: Path, masks: Path | None) -> list[str]:
            raise self.error

        def reconstruct(self, scene: Path, masks: Path | None) -> list[str]:
            raise self.error

    def report(name: str) -> SceneReport:
        scan = out / "meshes" / f"{name}.glb"
        return SceneReport(name, "crop", out / CROP / name, False, 2, "manifest", 0.1, scan)

    reports = [report("bowl_001"), report("bowl_002")]
    found = add_containers(out, reports, Refused(), tell=lambda line: None)
    assert [each.reason for each in found] == [f"{out / CROP}: Permission denied"] * 2
    Refused.error = DiskFullError("the disk is full")
    with pytest.raises(DiskFullError):
        add_containers(out, reports, Refused(), tell=lambda line: None)


def test_an_opaque_bowl_without_a_scan_comes_from_the_footage(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "real"
    texture = np.random.default_rng(0).uniform(40, 220, (48, 48, 48, 3))
    write_painted_scene(out / FULL / "bowl_004", texture)
    assert main(command(out, "bowl_004", variant=("full",))) == 0
    said = capsys.readouterr().err
    scene = Scene.open(out / FULL / "bowl_004")
    assert scene.meta is not None
    name = str(scene.meta.container_mesh)
    assert name.startswith("container_from_footage_")
    assert (scene.container_transparent, scene.gravity, scene.metres_per_unit) == (False, None, None)
    assert scene.container_mesh() is not None
    assert lines_about(said, "bowl_004") == [
        f"note: container of {FULL}/bowl_004: it was assumed to be opaque; a transparent one needs a scan"
    ]
    before = tree(out)
    assert main(command(out, "bowl_004", variant=("full",))) == 0
    assert f"already {name}" in capsys.readouterr().err
    assert tree(out) == before
    # One that is seen through is refused; so is what hides nothing.
    meta = json.loads((scene.directory / "scene.json").read_text())
    meta |= {"container_mesh": None, "container_pose": None, "container_transparent": True}
    (scene.directory / "scene.json").write_text(json.dumps(meta))
    assert main(command(out, "bowl_004", variant=("full",))) == 0
    (line,) = lines_about(capsys.readouterr().err, "bowl_004")
    assert "it is transparent" in line


def test_a_container_that_cannot_be_read_is_told(
    placed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = copied(placed, tmp_path)
    mesh = out / CROP / "bowl_001" / "container.glb"
    mesh.write_bytes(b"glTF and no more")
    assert main(command(out, "bowl_001", variant=("crop",))) == 1
    lines = [line for line in capsys.readouterr().err.splitlines() if "container.glb is not a readable mesh" in line]
    assert len(lines) == 1


def masks_command(out: Path, *names: str, variant: tuple[str, ...] = ("full", "crop")) -> list[str]:
    return ["download", "scenes", *(names or NAMES), str(out), "--variant", *variant, "--container-masks"]


def test_crops_get_the_whole_images_masks_cut_to_what_they_show(out: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(masks_command(out)) == 0
    assert "container masks: cut for 3 scenes now, there already in 3, missing in 0" in capsys.readouterr().err
    for name in NAMES:
        crop, whole = Scene.open(out / CROP / name), Scene.open(out / FULL / name)
        assert "container masks" in crop.stated
        for camera, view in crop.cameras.items():
            left, top = np.round(whole.cameras[camera].K[:2, 2] - view.K[:2, 2]).astype(int)
            mask = whole.container_mask(camera)
            assert mask is not None
            assert mask.any()
            expected = mask[top : top + view.height, left : left + view.width]
            np.testing.assert_array_equal(crop.container_mask(camera), expected)
    before = tree(out)
    assert main([*masks_command(out), "--json"]) == 0
    said = capsys.readouterr()
    assert "container masks: cut for 0 scenes now, there already in 6, missing in 0" in said.err
    assert "checking" not in said.err
    assert {each["count"] for each in json.loads(said.out)["container_masks"]} == {7}
    assert tree(out) == before


def test_a_crop_of_half_the_size_gets_every_second_pixel(out: Path) -> None:
    whole = Scene.open(out / FULL / "bowl_001")
    camera, mask = whole.cameras["1"], whole.container_mask("1")
    assert mask is not None
    K = camera.K.copy()
    K[:2] /= 2
    half = replace(camera, width=camera.width // 2, height=camera.height // 2, K=K)
    np.testing.assert_array_equal(_cut(mask, camera, half, "it"), mask[1::2, 1::2])
    K = camera.K.copy()
    K[0, 2] += 3
    with pytest.raises(SplashbenchError, match="it does not see all that the crop shows"):
        _cut(mask, camera, replace(camera, K=K), "it")


def moved_camera(out: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = out / FULL / "bowl_001" / "train_meta.json"
    meta = json.loads(path.read_text())
    for pose in meta["w2c"]:
        pose[0][0][3] += 0.1
    path.write_text(json.dumps(meta))


def test_an_empty_folder_of_masks_counts_as_none(out: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (out / CROP / "bowl_001" / "container_mask").mkdir()
    shutil.rmtree(out / FULL / "bowl_002" / "container_mask")
    (out / FULL / "bowl_002" / "container_mask").mkdir()
    assert main(masks_command(out, "bowl_001", "bowl_002")) == 1
    said = capsys.readouterr().err
    assert len(list((out / CROP / "bowl_001" / "container_mask").iterdir())) == 7
    errors = [line for line in said.splitlines() if line.startswith("error: ")]
    assert len(errors) == 2
    assert f"no container masks in {FULL}/bowl_002: " in errors[0]
    assert "has none; the archive has none for it" in errors[0]
    assert f"no container masks in {CROP}/bowl_002: " in errors[1]


@pytest.mark.parametrize(
    ("damage", "reason"),
    [
        (no_masks, "has no mask of a training camera; draw <camera>.png there"),
        (damaged_mask, "3.png"),
        (nothing_unpacked_whole, "is not unpacked: add --variant full crop"),
        (moved_camera, "camera 1 stands elsewhere than in"),
        (read_only, "bowl_001 may not be written"),
    ],
)
def test_masks_that_are_not_to_be_had_are_one_line(
    damage: Callable[[Path, pytest.MonkeyPatch], None],
    reason: str,
    out: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    damage(out, monkeypatch)
    before = tree(out / CROP / "bowl_001")
    assert main(masks_command(out, "bowl_001", "bowl_002", variant=("crop",))) == 1
    said = capsys.readouterr().err
    lines = [line for line in said.splitlines() if line.startswith("error: ")]
    assert len(lines) == 1, said
    assert lines[0].startswith(f"error: no container masks in {CROP}/bowl_001: ")
    assert reason in lines[0]
    assert tree(out / CROP / "bowl_001") == before
    assert len(list((out / CROP / "bowl_002" / "container_mask").iterdir())) == 7
    assert list(out.rglob(".tmp-*")) == []
