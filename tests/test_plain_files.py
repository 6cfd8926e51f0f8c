"""What is opened is a regular file of a sane size: no pipe is waited for, no device read, no sparse terabyte hashed."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest

from splashbench import toml
from splashbench.errors import SplashbenchError
from splashbench.files import image_size, read_gray, read_image, read_json, read_npz, sha256_file
from splashbench.files.contents import list_files
from splashbench.files.ply import read_point_cloud

pytestmark = pytest.mark.usefixtures("no_hang")


def sparse(path: Path) -> None:
    with path.open("wb") as stream:
        stream.truncate(1 << 40)


PLACES: dict[str, tuple[Callable[[Path], object], str]] = {
    "pipe": (os.mkfifo, "is a device or pipe"),
    "device": (lambda path: path.symlink_to("/dev/zero"), "is a device or pipe"),
    "folder": (Path.mkdir, "is a folder"),
    "kernel": (lambda path: path.symlink_to("/proc/kmsg"), "the system's own files"),
    "memory": (lambda path: path.symlink_to("/proc/self/mem"), "the system's own files"),
    "terabyte": (sparse, "is larger than"),
}
READERS: dict[str, Callable[[Path], object]] = {
    "JSON": read_json,
    "TOML": toml.load,
    "size of an image": image_size,
    "image": read_image,
    "mask": read_gray,
    "arrays": lambda path: read_npz(path, {"a": 1}),
    "digest": sha256_file,
    "points": read_point_cloud,
}


@pytest.mark.parametrize("reader", READERS)
@pytest.mark.parametrize("place", PLACES)
def test_what_is_no_plain_file_of_a_sane_size_is_refused_by_every_reader(
    place: str, reader: str, tmp_path: Path
) -> None:
    make, fault = PLACES[place]
    make(path := tmp_path / "file")
    with pytest.raises(SplashbenchError, match=fault) as caught:
        READERS[reader](path)
    assert str(path) in str(caught.value)


def test_a_listing_names_what_is_no_plain_file_and_opens_nothing(tmp_path: Path) -> None:
    (tmp_path / "a" / "b").mkdir(parents=True)
    (tmp_path / "a" / "b" / "plain").write_bytes(bytes(7))
    os.mkfifo(tmp_path / "a" / "pipe")
    (tmp_path / "link").symlink_to("/dev/zero")
    (tmp_path / "broken\nname").touch()
    Path(os.fsdecode(os.fsencode(tmp_path) + b"/\xff")).touch()
    listing = list_files(tmp_path)
    assert listing.names == ["a/b/plain"]
    assert listing.bytes == 7
    faults = "\n".join(listing.faults)
    assert len(listing.faults) == 4
    for part in ("a/pipe is a device or pipe", "link is a link", "a line break in its name", "a name that is no UTF-8"):
        assert part in faults


def test_a_listing_has_an_end(tmp_path: Path) -> None:
    for n in range(12):
        (tmp_path / str(n)).mkdir()
    with pytest.raises(SplashbenchError, match="more than 10 files and folders"):
        list_files(tmp_path, max_entries=10)
    (tmp_path / "deep").joinpath(*"a" * 40).mkdir(parents=True)
    with pytest.raises(SplashbenchError, match="more than 32 deep"):
        list_files(tmp_path)
