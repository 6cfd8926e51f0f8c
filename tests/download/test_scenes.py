"""`splashbench download scenes`: an archive on a drive becomes checked scenes with times, whatever it holds besides."""

from __future__ import annotations

import hashlib
import json
import random
import shutil
import signal
import stat
import struct
import subprocess
import sys
import time
import zipfile
from pathlib import Path
from typing import Any

import pytest

from splashbench.cli.main import main
from splashbench.download import scenes as module
from splashbench.download import unpacking
from splashbench.download.archive import ArchiveSource
from splashbench.download.fetch import Patience
from splashbench.download.scenes import STATE_FILE, check_downloaded, download_scenes, remembered_folder, require_names
from splashbench.download.unpacking import open_archive
from splashbench.errors import SplashbenchError
from splashbench.files import list_files, sha256_file
from splashbench.manifest import load_archive, load_scenes
from splashbench.scene import Scene
from splashbench.synth.release import imitations, write_release

QUICK = Patience(tries=2, wait_seconds=0.0, timeout_seconds=5.0)
NAMES = ["bowl_001", "tank_002"]


@pytest.fixture(autouse=True)
def _own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SPLASHBENCH_CACHE", str(tmp_path / "cache"))


@pytest.fixture(scope="module")
def archive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An imitation of the released archive with two small scenes, one of them scanned."""
    path = tmp_path_factory.mktemp("release") / "real_scene.zip"
    write_release(path, imitations(NAMES))
    return path


def page(server: Any, token: str = "ab-1") -> str:
    """The page on which the drive asks whether a large file is really wanted."""
    return f"""<!DOCTYPE html><html><head><title>Google Drive - Virus scan warning</title></head><body>
        <p class="uc-warning-caption">Google Drive can't scan this file for viruses.</p>
        <form id="download-form" action="{server.url}/download?x=1&amp;y=2" method="get">
        <input type="submit" id="uc-download-link" value="Download anyway"/>
        <input type="hidden" name="id" value="F&amp;1"><input type="hidden" name="confirm" value="t">
        <input type="hidden" name="uuid" value="{token}"></form></body></html>"""


FILE = "download?x=1&y=2&id=F%261&confirm=t&uuid=ab-1"


def on_drive(server: Any, content: bytes, **how: object) -> ArchiveSource:
    """The archive behind the drive's page."""
    server.add("uc", page(server).encode(), kind="text/html; charset=utf-8", cookie="warned=yes")
    server.add(FILE, content, kind="application/octet-stream", **how)
    return ArchiveSource(f"{server.url}/uc", f"{server.url}/view", "real_scene.zip")


def fetch(out: Path, source: ArchiveSource | None = None, **how: Any) -> list[module.SceneReport]:
    return download_scenes(
        out, how.pop("names", NAMES), tell=how.pop("tell", print), source=source, patience=QUICK, **how
    )


def test_the_archive_behind_the_drives_page_becomes_checked_scenes(archive: Path, server: Any, tmp_path: Path) -> None:
    out, content = tmp_path / "real", archive.read_bytes()
    source = on_drive(server, content)
    reports = fetch(out, source, variants=("full", "crop"))
    assert [(each.variant, each.name, each.frames, each.times_source) for each in reports] == [
        (variant, name, 6, "manifest") for variant in ("full", "crop") for name in NAMES
    ]
    assert [each.faults for each in reports] == [[]] * 4
    assert [each.mesh for each in reports] == [out / "meshes" / "bowl_001.glb", None] * 2
    step = load_scenes()["tank_002"].mean_step_ms / 1000
    assert reports[1].seconds == pytest.approx(5 * step)
    assert (out / "real_scene" / "bowl_001" / "container_mask" / "1.png").is_file()
    crop, full = (Scene.open(out / folder / "bowl_001") for folder in ("real_scene_crop", "real_scene"))
    assert (crop.cameras["1"].width, full.cameras["1"].width) == (96, 192)
    assert crop.is_released
    note = json.loads((out / "real_scene.zip.json").read_text())
    assert note["bytes"] == len(content)
    assert note["sha256"] == hashlib.sha256(content).hexdigest()
    assert "CC-BY-4.0" in (out / "ATTRIBUTION.txt").read_text()
    assert server.files[FILE].cookies_asked[-1] == "warned=yes"
    assert remembered_folder() == out.resolve()
    assert list(out.rglob(".tmp-*")) == []


def test_what_is_there_stays_and_is_not_checked_again(archive: Path, tmp_path: Path) -> None:
    out = tmp_path / "real"
    lines: list[str] = []
    fetch(out, by_hand=archive, names=["bowl_001"])
    place = out / "real_scene_crop" / "bowl_001" / "train_meta.json"
    before = place.stat().st_ino
    reports = fetch(out, by_hand=archive, tell=lines.append)
    assert [each.made for each in reports] == [False, True]
    assert place.stat().st_ino == before
    assert [line for line in lines if line.startswith("checking")] == ["checking real_scene_crop/tank_002 (2 of 2)"]
    lines.clear()
    fetch(out, tell=lines.append)  # no archive is at hand, and none is needed
    assert lines == []
    fetch(out, tell=lines.append, check_again=True)
    assert len(lines) == 2


def test_an_interrupted_download_goes_on(archive: Path, server: Any, tmp_path: Path) -> None:
    source = on_drive(server, archive.read_bytes(), cuts=[0, 300_000])  # looking takes no bytes
    fetch(tmp_path / "real", source, names=["bowl_001"])
    assert "bytes=300000-" in server.files[FILE].asked


def test_an_address_that_has_run_out_is_asked_for_anew(archive: Path, server: Any, tmp_path: Path) -> None:
    content = archive.read_bytes()
    source = on_drive(server, content, cuts=[0, 300_000])
    old = server.files[FILE]

    class Run(list):  # the first address answers with a page once the file has begun
        def append(self, value: object) -> None:
            super().append(value)
            if len(self) == 2:
                server.add("uc", page(server, "cd-2").encode(), kind="text/html")
                server.add(FILE.replace("ab-1", "cd-2"), content, kind="application/octet-stream")

    old.asked = Run()
    fetch(tmp_path / "real", source, names=["bowl_001"])
    assert server.files[FILE.replace("ab-1", "cd-2")].asked[-1] == "bytes=300000-"


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (
            '<title>Google Drive - Quota exceeded</title><p class="uc-error-caption">Sorry, you can\'t view or '
            'download this file at this time.</p><p class="uc-error-subcaption">Too many users have viewed or '
            "downloaded this file recently.</p>",
            "the drive answered: Sorry, you can't view or download this file at this time. Too many users have viewed",
        ),
        ("<html><title>Hotel Wi-Fi</title></html>", "a web page came instead of the file (Hotel Wi-Fi)"),
        ('<form id="download-form" action="file:///etc/passwd">', "it leads to file:///etc/passwd"),
        ("<title>Hotel</title><![<![", "a web page came instead of the file (Hotel)"),
        ('<form id="download-form" action="/uc">', "one page led to another, and none to the file"),
    ],
)
def test_a_page_in_place_of_the_archive_tells_the_way_by_hand(
    text: str, reason: str, server: Any, tmp_path: Path
) -> None:
    server.add("uc", text.encode(), kind="text/html")
    server.files["uc?"] = server.files["uc"]
    with pytest.raises(SplashbenchError) as raised:
        fetch(tmp_path / "real", ArchiveSource(f"{server.url}/uc", "https://drive.example/view", "real_scene.zip"))
    message = str(raised.value)
    assert reason in message
    assert f"open https://drive.example/view in a browser, save it as {tmp_path}/real/real_scene.zip" in message
    assert "--from real_scene.zip" in message
    assert not (tmp_path / "real" / "real_scene.zip").exists()


def test_what_is_no_archive_leaves_no_note_that_would_refuse_the_real_one(
    archive: Path, server: Any, tmp_path: Path
) -> None:
    out = tmp_path / "real"
    server.add("wrong.zip", b"Please log in", kind="application/octet-stream")
    with pytest.raises(SplashbenchError, match="is no zip archive, nothing was kept"):
        fetch(out, ArchiveSource(f"{server.url}/wrong.zip", "https://drive.example/view", "real_scene.zip"))
    assert len(fetch(out, on_drive(server, archive.read_bytes()))) == 2


def test_a_file_in_a_scenes_place_is_told_before_anything_is_fetched(archive: Path, tmp_path: Path) -> None:
    place = tmp_path / "real" / "real_scene_crop" / "bowl_001"
    place.parent.mkdir(parents=True)
    place.write_text("notes")
    with pytest.raises(SplashbenchError, match="is a file, where a scene belongs; move it away"):
        fetch(tmp_path / "real", by_hand=archive)


def test_without_a_network_the_command_says_what_to_do(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["download", "scenes", str(tmp_path / "real"), "--url", "http://127.0.0.1:9/real_scene.zip"]
    real = module.download_scenes
    monkeypatch.setattr(module, "download_scenes", lambda *words, **how: real(*words, patience=QUICK, **how))
    assert main(command) == 1
    (line,) = [line for line in capsys.readouterr().err.splitlines() if line.startswith("error")]
    assert "Connection refused" in line
    assert "save it as" in line


def test_another_archive_than_the_first_is_refused(archive: Path, tmp_path: Path) -> None:
    out, other = tmp_path / "real", tmp_path / "other.zip"
    fetch(out, by_hand=archive, names=["bowl_001"])
    other.write_bytes(archive.read_bytes() + b"\0")
    with pytest.raises(SplashbenchError, match=r"when it first came; .* remove .*real_scene\.zip\.json"):
        fetch(out, by_hand=other)
    changed = bytearray(archive.read_bytes())
    changed[200] ^= 1
    other.write_bytes(bytes(changed))
    with pytest.raises(SplashbenchError, match="has not the SHA-256"):
        fetch(out, by_hand=other)


def test_a_checksum_of_the_manifest_goes_before_the_note(archive: Path, tmp_path: Path) -> None:
    stated = load_archive().model_copy(update={"sha256": "0" * 64, "bytes": archive.stat().st_size})
    with pytest.raises(SplashbenchError, match="has not the SHA-256 0000"):
        fetch(tmp_path / "real", ArchiveSource.official(stated), by_hand=archive)
    good = load_archive().model_copy(update={"sha256": sha256_file(archive)})
    assert len(fetch(tmp_path / "real", ArchiveSource.official(good), by_hand=archive)) == 2


def test_a_page_that_was_saved_as_the_archive_is_told(tmp_path: Path) -> None:
    saved = tmp_path / "real_scene.zip"
    saved.write_text("<!DOCTYPE html><html>...")
    with pytest.raises(SplashbenchError, match="a web page that was saved in place of the archive"):
        fetch(tmp_path / "real", by_hand=saved)


def rewritten(archive: Path, path: Path, change: Any, extra: Any = None) -> Path:
    """The archive with `change`(info, content) for each entry, None to leave it out, and what `extra` adds."""
    with zipfile.ZipFile(archive) as old, zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as new:
        for info in old.infolist():
            made = change(info, old.read(info)) if change else (info, old.read(info))
            if made is not None:
                new.writestr(*made)
        if extra:
            extra(new)
    return path


def test_only_what_the_layout_holds_is_written(archive: Path, tmp_path: Path) -> None:
    def extra(new: zipfile.ZipFile) -> None:
        for name in (
            *("../../evil.txt", "/tmp/evil.txt", "data/real_scene_crop/bowl_001/../../../evil.jpg", "data/README.md"),
            *("__MACOSX/data/real_scene_crop/bowl_001/ims/1/._000000.jpg", "data/real_scene_crop/bowl_001/scene.json"),
            *("data/real_scene_crop/bowl_099/train_meta.json", "data/real_scene_crop/bowl_001/ims/1/run.sh"),
            *("data\\real_scene_crop\\bowl_001\\x.jpg", "data/real_scene_crop/bowl_001/ims/..\\..\\evil/0.jpg"),
        ):
            new.writestr(name, b"evil")

    bad = rewritten(archive, tmp_path / "bad.zip", None, extra)
    lines: list[str] = []
    out = tmp_path / "here" / "real"
    reports = fetch(out, by_hand=bad, tell=lines.append)
    assert [each.faults for each in reports] == [[], []]
    assert any("left out: 10 files that are no part of the layout, such as '../../evil.txt'" in line for line in lines)
    with zipfile.ZipFile(archive) as honest:
        names = {name for name in honest.namelist() if "/real_scene_crop/" in name}
    assert {f"data/real_scene_crop/{name}" for name in list_files(out / "real_scene_crop").names} == names
    assert [path.name for path in tmp_path.rglob("*evil*")] == []


def _as_link(new: zipfile.ZipFile) -> None:
    info = zipfile.ZipInfo("data/real_scene_crop/bowl_001/ims/1/000099.jpg")
    info.external_attr = (stat.S_IFLNK | 0o777) << 16
    new.writestr(info, "/etc/passwd")


def _as_bomb(new: zipfile.ZipFile) -> None:
    new.writestr("data/real_scene_crop/bowl_001/ims/1/000099.jpg", bytes(32 << 20))


def _too_large(new: zipfile.ZipFile) -> None:
    new.writestr("data/real_scene_crop/tank_001/train_meta.json", bytes(65 << 20))


def _twice(new: zipfile.ZipFile) -> None:
    new.writestr("real_scene_crop/bowl_001/train_meta.json", b"{}")


@pytest.mark.parametrize(
    ("extra", "reason"),
    [
        (_as_link, "000099.jpg is a link"),
        (_as_bomb, "000099.jpg is packed .* times, more than 200"),
        (_too_large, "train_meta.json has 68157440 bytes, more than"),
        (_twice, "train_meta.json twice"),
    ],
)
def test_an_archive_that_no_author_made_is_refused_whole(
    extra: Any, reason: str, archive: Path, tmp_path: Path
) -> None:
    bad = rewritten(archive, tmp_path / "bad.zip", None, extra)
    with pytest.raises(SplashbenchError, match=reason):
        fetch(tmp_path / "real", by_hand=bad)
    assert not (tmp_path / "real" / "real_scene_crop").exists()


def test_limits_on_the_list_and_on_the_whole(archive: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(unpacking, "MAX_ENTRIES", 20)
    with pytest.raises(SplashbenchError, match=r"lists 3\d\d files"), open_archive(archive):
        pass
    monkeypatch.undo()
    monkeypatch.setattr(unpacking, "MAX_GROWTH", 0)
    monkeypatch.setattr(unpacking, "_SMALL", 1000)
    with pytest.raises(SplashbenchError, match="as no release does"), open_archive(archive):
        pass


def with_long_end(archive: Path, path: Path, list_bytes: int | None = None, elsewhere: bool = False) -> Path:
    """The archive with the end of one that is too large for 32 bits, whose list has `list_bytes`.

    elsewhere: whether the locator points at a second, honest record.
    """
    content = archive.read_bytes()
    position = content.rfind(b"PK\5\6")
    count, honest, begin = struct.unpack_from("<HII", content, position + 10)

    def record(size: int) -> bytes:
        return struct.pack("<4sQHHIIQQQQ", b"PK\6\6", 44, 45, 45, 0, 0, count, count, size, begin)

    records = (record(honest) if elsewhere else b"") + record(list_bytes or honest)
    locator = struct.pack("<4sIQI", b"PK\6\7", 0, position, 1)
    short = struct.pack("<4sHHHHIIH", b"PK\5\6", 0, 0, 0xFFFF, 0xFFFF, 0xFFFFFFFF, 0xFFFFFFFF, 0)
    path.write_bytes(content[:position] + records + locator + short)
    return path


def test_the_list_of_a_very_large_archive_is_as_long_as_python_will_take_it_for(archive: Path, tmp_path: Path) -> None:
    with open_archive(with_long_end(archive, tmp_path / "good.zip")) as opened:
        assert len(opened.contents.scenes) == 4
    bad = tmp_path / "bad.zip"
    for elsewhere in (False, True):
        with (
            pytest.raises(SplashbenchError, match="lists"),
            open_archive(with_long_end(archive, bad, list_bytes=1 << 40, elsewhere=elsewhere)),
        ):
            pass


def test_an_entry_outside_the_archive_is_refused(archive: Path, tmp_path: Path) -> None:
    content = bytearray(archive.read_bytes())
    name = content.rfind(b"data/real_scene_crop/tank_002/train_meta.json")  # in the list, which is last
    content[name - 4 : name] = (0xFFFFFFF0).to_bytes(4, "little")
    bad = tmp_path / "bad.zip"
    bad.write_bytes(bytes(content))
    with pytest.raises(SplashbenchError, match=r"train_meta\.json lies outside the archive"), open_archive(bad):
        pass


def test_entries_over_each_other_are_refused(archive: Path, tmp_path: Path) -> None:
    """Fifield's bomb: many entries of one packed content."""
    content = bytearray(archive.read_bytes())
    with zipfile.ZipFile(archive) as honest:
        large = max(honest.infolist(), key=lambda info: info.compress_size)
        (listed,) = {honest.start_dir}
    position = content.find(b"PK\1\2", listed)
    while position >= 0:  # every entry claims the size of all
        content[position + 20 : position + 24] = (large.compress_size * 30).to_bytes(4, "little")
        position = content.find(b"PK\1\2", position + 4)
    bad = tmp_path / "bad.zip"
    bad.write_bytes(bytes(content))
    with pytest.raises(SplashbenchError, match="lie over each other"), open_archive(bad):
        pass


@pytest.mark.parametrize("cut", [0, 10, 1000, -1, -30])
def test_a_cut_archive_is_one_line(cut: int, archive: Path, tmp_path: Path) -> None:
    bad = tmp_path / "bad.zip"
    bad.write_bytes(archive.read_bytes()[:cut])
    with pytest.raises(SplashbenchError, match="zip archive"):
        fetch(tmp_path / "real", by_hand=bad)


def test_a_damaged_entry_leaves_no_half_scene(archive: Path, tmp_path: Path) -> None:
    content = bytearray(archive.read_bytes())
    with zipfile.ZipFile(archive) as honest:
        info = honest.getinfo("data/real_scene_crop/tank_002/ims/3/000002.jpg")
    begin = info.header_offset + 60 + len(info.filename)
    content[begin : begin + 40] = bytes(40)
    bad = tmp_path / "bad.zip"
    bad.write_bytes(bytes(content))
    with pytest.raises(SplashbenchError, match=r"ims/3/000002\.jpg is damaged"):
        fetch(tmp_path / "real", by_hand=bad)
    assert sorted(path.name for path in (tmp_path / "real" / "real_scene_crop").iterdir()) == ["bowl_001"]


def test_a_scene_with_a_fault_is_status_1(archive: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def damaged(info: zipfile.ZipInfo, data: bytes) -> tuple[zipfile.ZipInfo, bytes]:
        return info, b"no image" if info.filename.endswith("crop/tank_002/ims/3/000002.jpg") else data

    bad = rewritten(archive, tmp_path / "bad.zip", damaged)
    command = ["download", "scenes", "bowl_001", "tank_002", str(tmp_path / "real"), "--from", str(bad), "--json"]
    assert main(command) == 1
    said = capsys.readouterr()
    assert "ims/3/000002.jpg" in said.err
    assert "remove that folder to unpack it again" in said.err
    facts = json.loads(said.out)
    assert [bool(each["faults"]) for each in facts["scenes"]] == [False, True]


def test_names_that_are_no_scene() -> None:
    assert len(require_names([])) == 20
    assert require_names(["tank_001", "bowl_003"]) == ["bowl_003", "tank_001"]
    with pytest.raises(SplashbenchError, match="no scene 'bowl_01', did you mean"):
        require_names(["bowl_01"])
    with pytest.raises(SplashbenchError, match="splashbench download neurofluid"):
        require_names(["WaterSphere"])


def test_an_archive_without_a_scene_says_which(archive: Path, tmp_path: Path) -> None:
    with pytest.raises(SplashbenchError, match=r"holds no real_scene_crop/bowl_002, .* and 15 more"):
        fetch(tmp_path / "real", by_hand=archive, names=[])


def tree(folder: Path) -> dict[str, str]:
    """Every file's digest; locks aside."""
    return {name: sha256_file(folder / name) for name in list_files(folder).names if not name.endswith(".lock")}


@pytest.mark.slow
def test_killed_twenty_times_the_scenes_have_the_same_bytes(archive: Path, server: Any, tmp_path: Path) -> None:
    """Killed while it fetches, unpacks and checks, at moments spread over all of it."""
    source = on_drive(server, archive.read_bytes(), pause=0.004)
    whole = tmp_path / "whole"
    assert not any(each.faults for each in fetch(whole, source))
    out = tmp_path / "real"
    command = [sys.executable, "-m", "splashbench", "download", "scenes", *NAMES, str(out), "--url", source.url]
    draw, killed = random.Random(31), 0
    for _ in range(20):
        process = subprocess.Popen(command, stderr=subprocess.DEVNULL)
        end = time.monotonic() + draw.uniform(0.3, 2.0)
        while process.poll() is None and time.monotonic() < end:
            time.sleep(0.01)
        killed += process.poll() is None
        process.send_signal(signal.SIGKILL)
        process.wait()
        if draw.random() < 0.15:  # scenes are there soon: from the archive on, once more
            shutil.rmtree(out / "real_scene_crop", ignore_errors=True)
    assert killed >= 10
    assert subprocess.run(command, stderr=subprocess.PIPE, check=False).returncode == 0
    expected = tree(whole)
    found = tree(out)
    for notes in (expected, found):  # it names the address, which was a page's in one of them
        notes.pop("real_scene.zip.json")
    assert found == expected
    assert list(out.rglob(".tmp-*")) == []


def test_commands_that_check_scenes_of_one_folder_at_once_lose_no_note(tmp_path: Path) -> None:
    from concurrent.futures import ThreadPoolExecutor

    keys = [f"scene_{number}" for number in range(12)]
    for key in keys:
        (tmp_path / key).mkdir()

    def check(key: str) -> None:
        check_downloaded(tmp_path, key, made=True, again=False, tell=lambda text: None)

    with ThreadPoolExecutor(6) as pool:
        list(pool.map(check, keys))
    assert sorted(json.loads((tmp_path / STATE_FILE).read_text())["scenes"]) == sorted(keys)


def test_a_damaged_note_says_that_it_may_be_removed(tmp_path: Path) -> None:
    (tmp_path / "scene").mkdir()
    (tmp_path / STATE_FILE).write_text("{")
    with pytest.raises(SplashbenchError, match=r"scenes\.json cannot be read.*remove it"):
        check_downloaded(tmp_path, "scene", made=True, again=False, tell=lambda text: None)


@pytest.mark.parametrize("words", [["bowl_001"], ["bowl_001", "Tank_002"]])
def test_a_scene_is_not_taken_for_the_folder(
    words: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Without a folder the last name would be one, and the whole archive fetched into it."""
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as stop:
        main(["download", "scenes", *words])
    assert stop.value.code == 2
    assert f"{words[-1]} is a scene; DIR comes behind the names" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []
