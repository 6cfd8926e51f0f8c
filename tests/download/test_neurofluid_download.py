"""`splashbench download neurofluid`: a shared folder, archives and folders become checked scenes, and nothing else."""

from __future__ import annotations

import html
import io
import json
import os
import random
import shutil
import zipfile
from pathlib import Path
from typing import Any

import pytest

from splashbench.cli.main import main
from splashbench.download import neurofluid as module
from splashbench.download.connection import RefusedError
from splashbench.download.drive import locate
from splashbench.download.drive_folder import DriveFile, DriveFolder, list_drive_folder
from splashbench.download.fetch import Patience
from splashbench.download.neurofluid import download_neurofluid, may_hold_scene, require_neurofluid_names
from splashbench.download.neurofluid_files import gathered, place_in_scene
from splashbench.errors import SplashbenchError
from splashbench.files import atomic_directory
from splashbench.manifest import load_neurofluid
from splashbench.scene import Scene

from ..scene.conftest import AZIMUTHS, write_view

QUICK = Patience(tries=2, wait_seconds=0.0, timeout_seconds=5.0)
ROOT = "root-0123456789"


@pytest.fixture(scope="module")
def release(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder as the authors' may be: two scenes with a pickle each, a third that is another's, and networks."""
    folder = tmp_path_factory.mktemp("neurofluid") / "data_release"
    for scene in ("watersphere", "watercube"):
        for view in AZIMUTHS:
            write_view(folder / scene, view, "test" if view == "view_5" else "train", range(3), size=24)
        (folder / scene / "box.pt").write_bytes(b"a pickle")
    (folder / "bunny").mkdir()
    (folder / "bunny" / "a.txt").write_text("of another scene")
    return folder


def zipped(folder: Path, inner: str = "") -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        for path in sorted(folder.rglob("*")):
            if path.is_file():
                archive.write(path, f"{inner}{path.relative_to(folder)}")
    return stream.getvalue()


def listing(*entries: tuple[str, str]) -> bytes:
    """The drive's page of a folder: (name, identifier), where a folder's name ends in a slash."""
    rows = []
    for name, identifier in entries:
        kind = "drive/folders/" if name.endswith("/") else "file/d/"
        end = "" if name.endswith("/") else "/view?usp=drive_web"
        rows.append(
            f'<div class="flip-entry" id="entry-{identifier}" tabindex="0"><div class="flip-entry-info">'
            f'<a href="https://drive.google.com/{kind}{identifier}{end}" target="_blank">'
            f'<div class="flip-entry-visual"><img src="https://x/y.png" alt="Image"/></div>'
            f'<div class="flip-entry-title">{html.escape(name.rstrip("/"))}</div></a></div>'
            '<div class="flip-entry-last-modified"><div>Jan 1, 2022</div></div></div>'
        )
    return (
        "<!DOCTYPE html><html><head><title>release</title></head><body>"
        f'<div class="flip-list">{"".join(rows)}</div></body></html>'
    ).encode()


def on_drive(server: Any, folders: dict[str, list[tuple[str, str]]], files: dict[str, bytes]) -> DriveFolder:
    """A drive of `folders` (identifier -> entries) and `files` (identifier -> bytes)."""
    for identifier, entries in folders.items():
        server.add(f"embeddedfolderview?id={identifier}", listing(*entries), kind="text/html; charset=utf-8")
    for identifier, content in files.items():
        server.add(f"uc?export=download&id={identifier}", content, kind="application/octet-stream")
    return DriveFolder(ROOT, server.url)


def fetch(out: Path, *names: str, **how: Any) -> list[module.SceneReport]:
    return download_neurofluid(out, names, tell=how.pop("tell", print), patience=QUICK, **how)


def require_whole(out: Path, *names: str) -> None:
    for name in names:
        scene = Scene.open(out / name)
        assert (scene.n_frames, scene.times_source, len(scene.cameras)) == (3, "neurofluid", 5)
        assert not list((out / name).rglob("*.pt"))
    assert list(out.rglob(".tmp-*")) == []


def test_archives_on_the_drive_become_checked_scenes(release: Path, server: Any, tmp_path: Path) -> None:
    files = {
        "sphere-0123456789": zipped(release / "watersphere"),  # the archive alone bears the scene's name
        "cube-0123456789ab": zipped(release / "watercube", "watercube/"),
    }
    drive = on_drive(
        server,
        {
            ROOT: [
                ("data/", "data-0123456789"),
                ("pretrained_models/", "nets-0123456789"),
                ("a.pdf", "pdf-0123456789"),
            ],
            "data-0123456789": [("WaterSphere.zip", "sphere-0123456789"), ("watercube.zip", "cube-0123456789ab")],
            "nets-0123456789": [("watercube.zip", "net-0123456789"), ("up/", ROOT)],  # it leads round in a circle
        },
        files,
    )
    lines: list[str] = []
    reports = fetch(tmp_path / "out", "watersphere", "WATERCUBE", folder=drive, tell=lines.append)
    assert [(each.name, each.made, each.frames, each.faults) for each in reports] == [
        ("WaterSphere", True, 3, []),
        ("WaterCube", True, 3, []),
    ]
    require_whole(tmp_path / "out", "WaterSphere", "WaterCube")
    assert "2 files to fetch, 2 that are of no wanted scene left out" in lines
    note = json.loads((tmp_path / "out" / "neurofluid.json").read_text())
    assert {name: each["bytes"] for name, each in note["files"].items()} == {
        "data/WaterSphere.zip": len(files["sphere-0123456789"]),
        "data/watercube.zip": len(files["cube-0123456789ab"]),
    }
    assert "Licence: none stated" in (tmp_path / "out" / "ATTRIBUTION_neurofluid.txt").read_text()
    # Again: nothing is asked for.
    server.files.clear()
    lines.clear()
    assert [each.made for each in fetch(tmp_path / "out", "WaterCube", folder=drive, tell=lines.append)] == [False]
    assert lines == []


def test_loose_files_on_the_drive(release: Path, server: Any, tmp_path: Path) -> None:
    folders: dict[str, list[tuple[str, str]]] = {ROOT: [("watersphere/", "id-watersphere")]}
    files: dict[str, bytes] = {}
    for path in sorted((release / "watersphere").rglob("*")):
        name = str(path.relative_to(release)).replace("/", "-").replace(".", "-")
        above = "id-" + str(path.parent.relative_to(release)).replace("/", "-")
        folders.setdefault(above, []).append((path.name + ("/" if path.is_dir() else ""), f"id-{name}"))
        if path.is_file():
            files[f"id-{name}"] = path.read_bytes()
    drive = on_drive(server, folders, files)
    # An interrupted one goes on: what is there is not asked for again.
    broken = server.files["uc?export=download&id=id-watersphere-view_3-transforms_train-json"]
    broken.statuses = [404]
    with pytest.raises(SplashbenchError, match=r"transforms_train\.json could not be fetched from .*/view: the server"):
        fetch(tmp_path / "out", "WaterSphere", folder=drive)
    assert not (tmp_path / "out" / "WaterSphere").exists()
    first = server.files["uc?export=download&id=id-watersphere-view_1-transforms_train-json"]
    asked = len(first.asked)
    assert fetch(tmp_path / "out", "WaterSphere", folder=drive)[0].faults == []
    assert len(first.asked) == asked
    require_whole(tmp_path / "out", "WaterSphere")
    assert "uc?export=download&id=id-watersphere-box-pt" in server.files
    assert server.files["uc?export=download&id=id-watersphere-box-pt"].asked == []


def test_another_file_than_the_one_that_first_came(release: Path, server: Any, tmp_path: Path) -> None:
    content = zipped(release / "watersphere", "watersphere/")
    drive = on_drive(server, {ROOT: [("all.zip", "all-0123456789")]}, {"all-0123456789": content})
    out = tmp_path / "out"
    fetch(out, "WaterSphere", folder=drive)
    shutil.rmtree(out / "WaterSphere")
    (out / "neurofluid" / "all.zip").write_bytes(content[:-1] + b"x")  # damaged on the disk: fetched again
    fetch(out, "WaterSphere", folder=drive)
    shutil.rmtree(out / "WaterSphere")
    os.truncate(out / "neurofluid" / "all.zip", 100)
    server.add("uc?export=download&id=all-0123456789", content + b"more", kind="application/zip")
    with pytest.raises(SplashbenchError, match=r"had \d+ when it first came; if the authors have replaced it"):
        fetch(out, "WaterSphere", folder=drive)
    server.add("uc?export=download&id=all-0123456789", content[:-1] + b"x", kind="application/zip")
    with pytest.raises(SplashbenchError, match="has not the SHA-256"):
        fetch(out, "WaterSphere", folder=drive)
    assert not (out / "WaterSphere").exists()


@pytest.mark.parametrize("kind", ["folder", "scene", "link", "two zips", "numbered zips", "zip a view", "backslashes"])
def test_what_a_browser_fetched(release: Path, kind: str, tmp_path: Path) -> None:
    given: list[Path] = []
    if kind == "folder":
        given = [release]
    elif kind == "scene":
        given = [release / "watersphere"]
    elif kind == "link":
        given = [tmp_path / "watersphere", tmp_path / "watersphere"]
        given[0].symlink_to(shutil.copytree(release / "watersphere", tmp_path / "d1"))
    elif kind == "zip a view":
        given = [tmp_path / "watersphere"]
        given[0].mkdir()
        for view in AZIMUTHS:
            (given[0] / f"{view}.zip").write_bytes(zipped(release / "watersphere" / view, f"{view}/"))
    elif kind == "backslashes":
        given = [tmp_path / "a.zip"]
        with zipfile.ZipFile(given[0], "w") as archive:
            for path in sorted((release / "watersphere").rglob("*")):
                if path.is_file():
                    name = str(path.relative_to(release)).replace("/", "\\")
                    archive.writestr(zipfile.ZipInfo(name), path.read_bytes())
    elif kind == "numbered zips":
        for number, view in enumerate(AZIMUTHS):
            given.append(tmp_path / f"WaterSphere-{number}.zip")
            given[-1].write_bytes(zipped(release / "watersphere" / view, f"{view}/"))
    else:  # as a drive packs a large folder
        for number, part in enumerate(("view_[12]", "view_[345]")):
            given.append(tmp_path / f"drive-download-{number}.zip")
            with zipfile.ZipFile(given[-1], "w") as archive:
                for path in sorted((release / "watersphere").glob(f"{part}/**/*")):
                    if path.is_file():
                        archive.write(path, f"data_release/{path.relative_to(release)}")
    assert [each.faults for each in fetch(tmp_path / "out", "WaterSphere", by_hand=given)] == [[]]
    require_whole(tmp_path / "out", "WaterSphere")


def test_a_scene_that_is_not_there_or_there_twice(release: Path, tmp_path: Path) -> None:
    with pytest.raises(SplashbenchError, match=r"no file of HoneyCone .* by --from"):
        fetch(tmp_path / "out", by_hand=[release])
    assert not (tmp_path / "out" / "WaterCube").exists()
    shutil.copytree(release / "watercube", tmp_path / "two" / "watercube")
    shutil.copytree(release / "watercube", tmp_path / "two" / "watercube_viscous")
    with pytest.raises(SplashbenchError, match="holds WaterCube twice, as 'two/watercube' and 'two/watercube_viscous'"):
        fetch(tmp_path / "out", "WaterCube", by_hand=[tmp_path / "two"])
    with pytest.raises(SplashbenchError, match="gone is not there; give zip archives"):
        fetch(tmp_path / "out", "WaterCube", by_hand=[tmp_path / "gone"])


def entry(name: str, kind: int = 0, content: bytes = b"x") -> tuple[zipfile.ZipInfo, bytes]:
    info = zipfile.ZipInfo(name)
    info.external_attr = (kind | 0o644) << 16
    return info, content


HOSTILE = {
    "a link": ([entry("watercube/view_1/train/a.png", 0o120000, b"/etc/passwd")], "is a link"),
    "twice": ([entry("watercube/view_1/a.png")] * 2, "twice"),
    "twice, where case does not count": (
        [entry("watercube/view_1/a.png"), entry("watercube/view_1/A.png")],
        "twice",
    ),
    "a file and a folder": ([entry("watercube/view_1/a.png"), entry("watercube/view_1/a.png/b.png")], "twice"),
    "a folder and a file": ([entry("watercube/view_1/a.png/b.png"), entry("watercube/view_1/a.png")], "twice"),
    "a bomb": ([entry("watercube/view_1/a.npz", 0, bytes(20 << 20))], "is packed|unpacks to"),
}


@pytest.mark.filterwarnings("ignore:Duplicate name")
@pytest.mark.parametrize("case", HOSTILE)
def test_a_hostile_zip_archive(case: str, tmp_path: Path) -> None:
    entries, said = HOSTILE[case]
    with zipfile.ZipFile(tmp_path / "a.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        for info, content in entries:
            info.compress_type = zipfile.ZIP_DEFLATED
            archive.writestr(info, content)
    with pytest.raises(SplashbenchError, match=said):
        fetch(tmp_path / "out", "WaterCube", by_hand=[tmp_path / "a.zip"])
    assert not (tmp_path / "out" / "WaterCube").exists()


def test_damaged_archives_are_told(release: Path, tmp_path: Path) -> None:
    path = tmp_path / "watersphere.zip"
    content = zipped(release / "watersphere")
    draw = random.Random(1)
    told = []
    for number in range(150):
        damaged = bytearray(content)
        for _ in range(draw.choice([1, 4, 64])):
            damaged[draw.randrange(len(damaged))] = draw.randrange(256)
        path.write_bytes(bytes(damaged)[: draw.randrange(len(damaged)) if number % 3 == 0 else len(damaged)])
        out = tmp_path / f"out{number}"
        try:
            fetch(out, "WaterSphere", by_hand=[path])
        except SplashbenchError as error:
            told.append(str(error))
            assert not (out / "WaterSphere").exists()
    assert len(told) > 50
    assert all(str(path) in each for each in told)


def test_names_that_lead_elsewhere_belong_to_nothing(tmp_path: Path) -> None:
    for name in (
        "watercube/view_1/../../../a.png",
        "watercube/view_1/.a.png",
        "/watercube/view_1/a.sh",
        "watercube/view_1/box.pt",
        "view_1/transforms_train.json",
        "bunny/view_1/transforms_train.json",
        "watercube/a.png",
        "watercube/view_\u0661/a.png",
    ):
        assert place_in_scene(name.split("/")) is None, name
    assert place_in_scene(["data", "Water_Cube", "v2", "view_12", "train", "r_1.png"]) == (
        "WaterCube",
        "data/Water_Cube/v2",
        "view_12/train/r_1.png",
    )
    with gathered([], ["WaterCube"], print) as nothing:
        assert nothing.scenes == {}


def test_which_files_of_the_drive_are_fetched() -> None:
    def of(path: str) -> bool:
        return may_hold_scene(DriveFile(tuple(path.split("/")), "x"), ["WaterCube"])

    assert of("data/watercube.zip")
    assert of("release.zip")
    assert not of("release.tar.gz")
    assert of("watercube/view_1/transforms_train.json")
    assert not of("watersphere.zip")
    assert not of("watersphere/view_1/transforms_train.json")
    assert not of("models/watercube.zip")
    assert not of("watercube/box.pt")
    assert not of("watercube.rar")


def test_a_folder_that_is_no_folder(server: Any) -> None:
    def listed(content: bytes, kind: str = "text/html") -> str:
        server.add(f"embeddedfolderview?id={ROOT}", content, kind=kind)
        drive = DriveFolder(ROOT, server.url)
        try:
            return str(list_drive_folder(drive, remedy="REMEDY", tell=print, patience=QUICK))
        except SplashbenchError as error:
            return str(error)

    assert "could not be listed: a web page came instead of the file (Sign in)" in listed(
        b"<html><head><title>Sign in</title></head><body><a href='/x'>x</a></body></html>"
    )
    assert "REMEDY" in listed(b"PK\x03\x04", "application/zip")
    assert "could not be listed" in listed(b"x" * (2 << 20))
    assert listed(listing()) == "[]"  # an empty one
    rows = listing(("a\x1b[31m\n b", "id-0123456789"), ("..", "id-0123456780"), ("&lt;<x>", "id-0123456781"))
    assert "'a\\x1b[31m b'" in listed(rows)
    many = [(f"f{number}.png", f"id-{number:012}") for number in range(6000)]
    assert "a very long web page" in listed(listing(*many))
    server.files.clear()
    server.add(f"embeddedfolderview?id={ROOT}", b"", statuses=[404])
    with pytest.raises(SplashbenchError, match="answered 404"):
        list_drive_folder(DriveFolder(ROOT, server.url), remedy="REMEDY", tell=print, patience=QUICK)


def test_folders_without_end_are_refused(server: Any) -> None:
    for number in range(12):
        server.add(
            f"embeddedfolderview?id=folder-{number:09}", listing(("x/", f"folder-{number + 1:09}")), kind="text/html"
        )
    with pytest.raises(SplashbenchError, match="8 folders within each other"):
        list_drive_folder(DriveFolder("folder-000000000", server.url), remedy="REMEDY", tell=print, patience=QUICK)


def test_names_of_the_drive_that_no_file_can_have(release: Path, server: Any, tmp_path: Path) -> None:
    content = zipped(release / "watersphere", "watersphere/")
    drive = on_drive(
        server,
        {ROOT: [("..", "dots-0123456789"), ("../../x.zip", "up-0123456789"), ("x y;.zip", "good-0123456789")]},
        {"up-0123456789": b"PK", "good-0123456789": content},
    )
    lines: list[str] = []
    fetch(tmp_path / "out", "WaterSphere", folder=drive, tell=lines.append)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out"]
    assert (tmp_path / "out" / "neurofluid" / "x_y_.zip").read_bytes() == content
    assert any("left out: ../../x.zip" in line for line in lines)


def test_the_names() -> None:
    assert require_neurofluid_names([]) == ["WaterSphere", "WaterCube", "HoneyCone"] == list(load_neurofluid().scenes)
    assert require_neurofluid_names(["honeycone", "WaterCube"]) == ["WaterCube", "HoneyCone"]
    with pytest.raises(SplashbenchError, match="no scene 'watersfere', did you mean 'WaterSphere'"):
        require_neurofluid_names(["watersfere"])


def test_the_command(release: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    command = ["download", "neurofluid", "WaterSphere", "watercube", str(out), "--from", str(release), "--json"]
    assert main(command) == 0
    said = capsys.readouterr()
    assert [each["frames"] for each in json.loads(said.out)["scenes"]] == [3, 3]
    assert f"run methods on them with: splashbench benchmark run OUT --scenes {out}" in said.err
    next((out / "WaterCube" / "view_2" / "train").glob("*.png")).write_bytes(b"no picture")
    assert main([*command, "--check"]) == 1
    assert "remove that folder to unpack it again" in capsys.readouterr().err
    from splashbench.benchmark.scenes import find_scenes

    assert [path.name for path in find_scenes([str(out)])] == ["WaterCube", "WaterSphere"]


def test_dir_that_was_forgotten(release: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: Any) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as stopped:
        main(["download", "neurofluid", "watersphere", "--from", str(release), "out"])
    assert stopped.value.code == 2
    assert "DIR comes behind the names, and before --from" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_other_archives_beside_the_scenes(release: Path, tmp_path: Path) -> None:
    folder = tmp_path / "downloads"
    folder.mkdir()
    (folder / "watersphere.zip").write_bytes(zipped(release / "watersphere"))
    (folder / "other.zip").write_bytes(b"no archive")
    os.mkfifo(folder / "pipe")
    lines: list[str] = []
    fetch(tmp_path / "out", "WaterSphere", by_hand=[folder], tell=lines.append)
    require_whole(tmp_path / "out", "WaterSphere")
    assert any(line.startswith("left out: ") and "other.zip is no whole zip archive" in line for line in lines)
    assert any("pipe" in line for line in lines)
    (folder / "watersphere.zip").unlink()
    (folder / "watersphere.tar.gz").write_bytes(b"x")
    with pytest.raises(SplashbenchError, match=r"but archives are, such as .*watersphere\.tar\.gz: unpack them"):
        fetch(tmp_path / "more", "WaterSphere", by_hand=[folder])
    with pytest.raises(SplashbenchError, match=r"other\.zip is no whole zip archive"):
        fetch(tmp_path / "more", "WaterSphere", by_hand=[folder / "other.zip"])


def test_what_lies_there_is_not_lost(release: Path, server: Any, tmp_path: Path) -> None:
    """Files without a note: put there by hand, or left by a run that was killed before it took the note."""
    content = zipped(release / "watersphere", "watersphere/")
    drive = on_drive(server, {ROOT: [("all.zip", "all-0123456789")]}, {"all-0123456789": content})
    place = tmp_path / "out" / "neurofluid" / "all.zip"
    place.parent.mkdir(parents=True)
    place.write_bytes(b"mine")
    with pytest.raises(SplashbenchError, match=r"has 4 bytes, and .*; move it away"):
        fetch(tmp_path / "out", "WaterSphere", folder=drive)
    assert place.read_bytes() == b"mine"
    place.write_bytes(content)
    before = place.stat().st_ino
    served = server.files["uc?export=download&id=all-0123456789"]
    asked = len(served.asked)
    fetch(tmp_path / "out", "WaterSphere", folder=drive)
    assert place.stat().st_ino == before
    assert len(served.asked) == asked + 1  # for its size
    # A scene whose archive has another name by now, too.
    shutil.rmtree(tmp_path / "out" / "WaterSphere")
    drive = on_drive(server, {ROOT: [("v2.zip", "v2-0123456789")]}, {"v2-0123456789": content})
    fetch(tmp_path / "out", "WaterSphere", folder=drive)
    require_whole(tmp_path / "out", "WaterSphere")


def test_a_download_that_went_wrong_is_not_noted(release: Path, server: Any, tmp_path: Path) -> None:
    content = zipped(release / "watersphere", "watersphere/")
    drive = on_drive(server, {ROOT: [("all.zip", "all-0123456789")]}, {"all-0123456789": b"quota exceeded" * 9})
    part = tmp_path / "out" / "neurofluid" / "all.zip.part"
    with pytest.raises(SplashbenchError, match="is no whole zip archive; nothing was kept; open"):
        fetch(tmp_path / "out", "WaterSphere", folder=drive)
    assert [path.name for path in part.parent.iterdir()] == []
    server.add("uc?export=download&id=all-0123456789", content, kind="application/zip")
    part.write_bytes(b"the beginning of another file")
    fetch(tmp_path / "out", "WaterSphere", folder=drive)
    require_whole(tmp_path / "out", "WaterSphere")
    # Interrupted: the rest is asked for.
    shutil.rmtree(tmp_path / "out")
    served = server.add("uc?export=download&id=all-0123456789", content, kind="application/zip", cuts=[0, 1000])[1]
    fetch(tmp_path / "out", "WaterSphere", folder=drive)
    assert "bytes=1000-" in served.asked


def test_leftovers_in_a_relative_folder(release: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    with atomic_directory(Path("out/WaterSphere")) as staging:
        kept = shutil.copytree(staging, "kept")
        name = staging.name
    shutil.rmtree("out")
    shutil.move(kept, Path("out") / name)
    fetch(Path("out"), "WaterSphere", by_hand=[release])
    require_whole(Path("out"), "WaterSphere")


def test_addresses_that_are_none(server: Any) -> None:
    server.add(f"embeddedfolderview?id={ROOT}", b"", location="http://[")
    with pytest.raises(SplashbenchError, match="it leads to"):
        list_drive_folder(DriveFolder(ROOT, server.url), remedy="REMEDY", tell=print, patience=QUICK)
    page = b"<form id='download-form' action='http://['><input type='hidden' name='a' value='b'></form>"
    server.add("uc", page, kind="text/html")
    with pytest.raises(RefusedError, match="leads to what is no address"):
        locate(f"{server.url}/uc", 5.0)
    server.add("uc", b"<a " * 50_000, kind="text/html")
    with pytest.raises(RefusedError, match="no web page"):
        locate(f"{server.url}/uc", 5.0)
