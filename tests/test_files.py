"""Files: whole or not at all, and nothing from strangers is trusted."""

import errno
import hashlib
import io
import os
import struct
import tracemalloc
import zipfile
from pathlib import Path

import numpy as np
import pytest

from splashbench import toml
from splashbench.errors import DiskFullError, SplashbenchError
from splashbench.files import (
    NO_ROOM,
    atomic_directory,
    atomic_path,
    files_together,
    read_gray,
    read_image,
    read_json,
    read_npz,
    sha256_file,
    tree_bytes,
    write_image,
    write_json,
    write_npz,
    write_png,
)


def test_a_failed_write_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    write_json(path, {"a": 1})
    with pytest.raises(ValueError), atomic_path(path) as temporary:
        temporary.write_text("half")
        raise ValueError
    assert read_json(path) == {"a": 1}
    assert [entry.name for entry in tmp_path.iterdir()] == ["a.json"]


def test_a_failed_directory_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(ValueError), atomic_directory(tmp_path / "out") as staging:
        (staging / "file").write_text("half")
        raise ValueError
    assert list(tmp_path.iterdir()) == []


def test_an_existing_directory_is_replaced_only_when_asked(tmp_path: Path) -> None:
    out = tmp_path / "out"
    for content in ("first", "second"):
        with atomic_directory(out, replace=content == "second") as staging:
            (staging / "file").write_text(content)
    assert (out / "file").read_text() == "second"
    with pytest.raises(SplashbenchError, match="exists already"), atomic_directory(out):
        pass
    with pytest.raises(ValueError), atomic_directory(out, replace=True) as staging:
        raise ValueError
    assert (out / "file").read_text() == "second"


def test_a_full_disk_is_one_line_naming_the_file(tmp_path: Path) -> None:
    path = tmp_path / "big.json"
    with pytest.raises(DiskFullError, match=r"big.json could not be written: the disk is full"), atomic_path(path):
        raise OSError(errno.ENOSPC, "No space left on device")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("number", NO_ROOM)
def test_a_library_that_tells_of_no_room_in_words_is_understood(number: int, tmp_path: Path) -> None:
    said = RuntimeError(f"Failed to write: {os.strerror(number)}")  # as OpenUSD and OpenEXR raise
    for writing in (
        atomic_path(tmp_path / "out"),
        atomic_directory(tmp_path / "out"),
        files_together(tmp_path / "out"),
    ):
        with pytest.raises(DiskFullError, match="out could not be written: the disk is full"), writing:
            raise said
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("links", [True, False])
def test_what_another_process_has_just_written_stays(
    links: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def no_links(*_: object) -> None:
        raise PermissionError

    if not links:
        monkeypatch.setattr(os, "link", no_links)
    path = tmp_path / "a.json"
    with atomic_path(path, replace=False) as temporary:
        temporary.write_text("mine")
    assert path.read_text() == "mine"
    assert path.stat().st_nlink == 1
    assert list(tmp_path.iterdir()) == [path]
    with pytest.raises(SplashbenchError, match="exists already"), atomic_path(tmp_path / "b", False) as temporary:
        temporary.write_text("mine")
        (tmp_path / "b").write_text("theirs")
    assert (tmp_path / "b").read_text() == "theirs"


def test_a_name_that_is_taken_after_the_last_look_stays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.json"
    with pytest.raises(SplashbenchError, match=r"a\.json exists already"), atomic_path(path, False) as temporary:
        temporary.write_text("mine")
        monkeypatch.setattr("splashbench.files.atomic.require_file_place", lambda *_: path.write_text("theirs"))
    assert path.read_text() == "theirs"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_a_full_disk_within_an_image_writer_is_told_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(path: Path) -> Path:
        link = tmp_path / f"full-{path.name}"
        link.symlink_to("/dev/full")
        return link

    monkeypatch.setattr("splashbench.files.atomic._sibling", full)
    noise = np.random.default_rng(0).integers(0, 255, (300, 300, 3), dtype=np.uint8)
    for name in ("image.jpg", "image.png"):
        with pytest.raises(DiskFullError, match=f"{name} could not be written: the disk is full"):
            write_image(tmp_path / name, noise)
    assert list(tmp_path.iterdir()) == []


def test_images_come_back_as_written(tmp_path: Path) -> None:
    rgb = np.random.default_rng(0).integers(0, 255, (5, 7, 3), dtype=np.uint8)
    write_png(tmp_path / "rgb.png", rgb)
    assert (read_image(tmp_path / "rgb.png") == rgb).all()
    write_png(tmp_path / "gray.png", rgb[..., 0])
    assert (read_gray(tmp_path / "gray.png") == rgb[..., 0]).all()


def test_a_truncated_image_is_named(tmp_path: Path) -> None:
    path = tmp_path / "cut.png"
    write_png(path, np.random.default_rng(0).integers(0, 255, (64, 64, 3), dtype=np.uint8))
    path.write_bytes(path.read_bytes()[:2000])
    with pytest.raises(SplashbenchError, match=r"cut.png is cut short or damaged"):
        read_image(path)


def test_nan_never_reaches_a_json_file(tmp_path: Path) -> None:
    with pytest.raises(ValueError):
        write_json(tmp_path / "a.json", {"a": float("nan")})
    assert list(tmp_path.iterdir()) == []


def test_deep_json_is_refused_not_crashed_on(tmp_path: Path) -> None:
    path = tmp_path / "deep.json"
    path.write_text("[" * 200_000)
    with pytest.raises(SplashbenchError, match=r"deep.json cannot be read"):
        read_json(path)


def test_npz_without_pickles_and_with_the_right_ranks(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    np.savez(path, a=np.zeros((2, 3)), b=np.array([object()], dtype=object), c=np.array([np.nan]))
    assert read_npz(path, {"a": 2})["a"].shape == (2, 3)
    with pytest.raises(SplashbenchError, match="a has 2 dimensions, not 3"):
        read_npz(path, {"a": 3})
    with pytest.raises(SplashbenchError, match="without pickles"):
        read_npz(path, {"b": 1})
    with pytest.raises(SplashbenchError, match="NaN"):
        read_npz(path, {"c": 1})
    with pytest.raises(SplashbenchError, match="lacks the array 'd'"):
        read_npz(path, {"d": 1})
    path.write_bytes(b"PK\x03\x04 nonsense")
    with pytest.raises(SplashbenchError, match=r"a.npz is not a readable"):
        read_npz(path, {"a": 2})


def test_what_is_no_array_in_an_archive_is_named(tmp_path: Path) -> None:
    path = tmp_path / "odd.npz"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("a.npy", b"not an array")
    with pytest.raises(SplashbenchError, match=r"odd\.npz: a is not an array"):
        read_npz(path, {"a": 1})


def test_a_bzipped_bomb_is_unpacked_no_further_than_it_is_read(tmp_path: Path) -> None:
    """zipfile unpacks whatever the packed bytes hold that it has read: a block of 40 bytes holds 46 MB."""
    path, true, claimed = tmp_path / "bomb.npz", 184_000_000, 8 * 100 + 128
    with zipfile.ZipFile(path, "w", zipfile.ZIP_BZIP2) as archive:
        archive.writestr("a.npy", bytes(true))
    content = path.read_bytes()
    assert len(content) < 2000
    path.write_bytes(content.replace(struct.pack("<I", true), struct.pack("<I", claimed)))
    tracemalloc.start()
    try:
        with pytest.raises(SplashbenchError, match=r"bomb\.npz: a is not an array"):
            read_npz(path, {"a": 1})
        assert tracemalloc.get_traced_memory()[1] < 30_000_000
    finally:
        tracemalloc.stop()


def test_bzipped_arrays_that_are_damaged_or_longer_than_stated_are_refused(tmp_path: Path) -> None:
    path, array = tmp_path / "a.npz", np.random.default_rng(0).integers(0, 255, 5000).astype(np.uint8)
    write_npz(path, {"a": array})
    np.testing.assert_array_equal(read_npz(path, {"a": 1})["a"], array)
    with zipfile.ZipFile(path) as archive:
        entry = archive.infolist()[0]
    content = path.read_bytes()
    other_sum = content.replace(struct.pack("<I", entry.CRC), struct.pack("<I", entry.CRC ^ 1))
    assert other_sum != content
    path.write_bytes(other_sum)
    with pytest.raises(SplashbenchError, match=r"a\.npz is not a readable .npz .*is damaged"):
        read_npz(path, {"a": 1})
    longer = np.lib.format.header_data_from_array_1_0(array)
    with io.BytesIO() as stream:
        np.lib.format.write_array_header_1_0(stream, longer)
        header = stream.getvalue()
    with zipfile.ZipFile(path, "w", zipfile.ZIP_BZIP2) as archive:
        archive.writestr("a.npy", header + array.tobytes() + b"more")
    true, stated = len(header) + len(array) + 4, len(header) + len(array)
    path.write_bytes(path.read_bytes().replace(struct.pack("<I", true), struct.pack("<I", stated)))
    with pytest.raises(SplashbenchError, match=r"a\.npz is not a readable .npz .*is damaged"):
        read_npz(path, {"a": 1})


def test_a_zip_bomb_is_refused_by_its_header(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "bomb.npz"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("a.npy", b"\0" * 1_000_000)
    monkeypatch.setattr("splashbench.files.arrays.MAX_NPZ_BYTES", 1000)
    with pytest.raises(SplashbenchError, match="unpacks to more than"):
        read_npz(path, {"a": 1})


def test_a_file_of_text_larger_than_its_limit_is_not_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, module, load in (
        ("a.json", "files.documents.MAX_JSON_BYTES", read_json),
        ("a.toml", "toml._MAX_BYTES", toml.load),
    ):
        monkeypatch.setattr(f"splashbench.{module}", 1 << 20)
        (tmp_path / name).write_text(" " * ((1 << 20) + 1))
        with pytest.raises(SplashbenchError, match=rf"{name} is larger than 1 MiB"):
            load(tmp_path / name)


def test_a_failed_write_removes_the_folder_it_made(tmp_path: Path) -> None:
    with pytest.raises(ValueError), atomic_path(tmp_path / "new" / "a.json"):
        raise ValueError
    assert list(tmp_path.iterdir()) == []


def test_an_output_never_takes_the_place_of_its_input(tmp_path: Path) -> None:
    (tmp_path / "scene" / "ims").mkdir(parents=True)
    with (
        pytest.raises(SplashbenchError, match="holds the input"),
        atomic_directory(tmp_path / "scene", replace=True, inputs=[tmp_path / "scene" / "ims"]),
    ):
        pass
    assert (tmp_path / "scene" / "ims").is_dir()


def test_the_size_of_a_folder_leaves_links_out(tmp_path: Path) -> None:
    (tmp_path / "below").mkdir()
    (tmp_path / "below" / "file").write_bytes(bytes(1000))
    (tmp_path / "file").write_bytes(bytes(24))
    (tmp_path / "link").symlink_to(tmp_path / "below" / "file")
    assert tree_bytes(tmp_path) == 1024
    assert tree_bytes(tmp_path / "nowhere") == 0
    assert sha256_file(tmp_path / "file") == hashlib.sha256(bytes(24)).hexdigest()


def _archive(path: Path, name: str, header: str, data: bytes, kind: int = zipfile.ZIP_DEFLATED) -> Path:
    with zipfile.ZipFile(path, "w", kind) as archive:
        text = header.encode() + b"\n"
        archive.writestr(f"{name}.npy", b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text + data)
    return path


@pytest.mark.parametrize(
    ("header", "said"),
    [
        ("{'descr': '<f8', 'fortran_order': False, 'shape': (-1, -8)}", "states float64"),
        ("{'descr': '<f8', 'fortran_order': False, 'shape': (2, 8)}", "states float64"),
        ("{'descr': '<f16', 'fortran_order': False, 'shape': (2, 2)}", "not numbers"),
        ("{'descr': '<c16', 'fortran_order': False, 'shape': (2, 2)}", "not numbers"),
        ("{'descr': '|O', 'fortran_order': False, 'shape': (2, 2)}", "without pickles"),
        ("{'descr': '<M8[s]', 'fortran_order': False, 'shape': (2, 4)}", "not numbers"),
        ("{'descr': '<f8'", "not a readable"),
        ("(" * 3000, "not a readable"),
        ("", "not a readable"),
    ],
)
def test_an_array_whose_header_makes_no_sense_is_named(header: str, said: str, tmp_path: Path) -> None:
    path = _archive(tmp_path / "a.npz", "a", header, bytes(64))
    with pytest.raises(SplashbenchError, match=said):
        read_npz(path, {"a": 2})


def test_only_arrays_that_are_asked_for_are_unpacked(tmp_path: Path) -> None:
    np.savez(path := tmp_path / "a.npz", a=np.arange(6.0).reshape(2, 3).T, b=np.array([object()]))
    array = read_npz(path, {"a": 2}, {"c": 1})["a"]
    np.testing.assert_array_equal(array, np.arange(6.0).reshape(2, 3).T)


def test_a_damaged_checksum_is_found(tmp_path: Path) -> None:
    np.savez(path := tmp_path / "a.npz", a=np.arange(1000.0))
    content = bytearray(path.read_bytes())
    content[3000] ^= 1
    path.write_bytes(bytes(content))
    with pytest.raises(SplashbenchError, match="Bad CRC-32"):
        read_npz(path, {"a": 1})


def test_an_archive_of_very_many_entries_is_refused_before_they_are_listed(tmp_path: Path) -> None:
    with zipfile.ZipFile(path := tmp_path / "a.npz", "w") as archive:
        for n in range(1200):
            archive.writestr(f"{n}.npy", b"")
    with pytest.raises(SplashbenchError, match="more than 1000 arrays"):
        read_npz(path, {"a": 1})
    with zipfile.ZipFile(path, "w") as archive:
        for n in range(30_000):
            archive.writestr(f"{n:0150}", b"")
    with pytest.raises(SplashbenchError, match="its list of entries is too long"):
        read_npz(path, {"a": 1})
