"""Folders of photographs are read like recordings, upright, and what is wrong with them is one line."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from splashbench.errors import SplashbenchError
from splashbench.prepare.video.recording import Recording
from splashbench.prepare.video.stills import Stills, open_recording


def photograph(path: Path, value: int = 0, size: tuple[int, int] = (40, 24), orientation: int | None = None) -> None:
    """A photograph whose upper left quarter is brighter than the rest."""
    image = np.full((size[1], size[0], 3), 60 + value, np.uint8)
    image[: size[1] // 2, : size[0] // 2] = 200
    path.parent.mkdir(parents=True, exist_ok=True)
    exif = Image.Exif()
    if orientation is not None:
        exif[0x0112] = orientation
    Image.fromarray(image).save(path, exif=exif)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name, value in (("b.PNG", 10), ("a.png", 0), ("c.jpg", 20)):
        photograph(tmp_path / "board" / name, value)
    (tmp_path / "board" / "notes.txt").write_text("not a photograph")
    (tmp_path / "board" / ".hidden.png").write_bytes(b"rubbish")
    return tmp_path / "board"


def test_photographs_come_in_order_of_their_names(folder: Path) -> None:
    stills = Stills([folder])
    assert (stills.info.width, stills.info.height, stills.info.n_frames) == (40, 24, 3)
    assert stills.frame_times.tolist() == [0.0, 1.0, 2.0]
    frames = list(stills.frames())
    assert [index for index, _ in frames] == [0, 1, 2]
    assert [round(float(image[-1, -1].mean()), -1) for _, image in frames] == [60, 70, 80]
    assert frames[0][1].shape == (24, 40, 3)
    assert frames[0][1].dtype == np.uint8
    assert [index for index, _ in stills.frames([2, 0, 2])] == [0, 2]
    with pytest.raises(ValueError, match=r"0\.\.2"):
        list(stills.frames([3]))


def test_luma_is_shrunk_by_area(folder: Path) -> None:
    small = list(Stills([folder]).luma(20, first=1))
    assert [index for index, _ in small] == [1, 2]
    assert small[0][1].shape == (12, 20)
    np.testing.assert_allclose(small[0][1][[0, -1], [0, -1]], [200, 70], atol=1)


@pytest.mark.parametrize(("orientation", "corner"), [(1, (0, 0)), (3, (-1, -1)), (6, (0, -1)), (8, (-1, 0))])
@pytest.mark.parametrize("suffix", ["jpg", "png"])
def test_the_orientation_tag_is_applied(tmp_path: Path, orientation: int, corner: tuple[int, int], suffix: str) -> None:
    photograph(tmp_path / f"a.{suffix}", orientation=orientation)
    stills = Stills([tmp_path])
    ((_, image),) = stills.frames()
    assert image.shape[:2] == (stills.info.height, stills.info.width)
    assert image.shape[:2] == ((24, 40) if orientation < 5 else (40, 24))
    assert image[corner].mean() > 180
    assert image[(-1 - corner[0], -1 - corner[1])].mean() < 80


def test_several_folders_follow_one_another(folder: Path, tmp_path: Path) -> None:
    photograph(tmp_path / "more" / "a.png", 30)
    frames = dict(Stills([folder, tmp_path / "more"]).frames())
    assert len(frames) == 4
    assert frames[3][-1, -1, 0] == 90


def test_open_recording_tells_videos_from_folders(folder: Path, tmp_path: Path) -> None:
    assert isinstance(open_recording([folder]), Stills)
    assert isinstance(open_recording([tmp_path / "GX010001.MP4"]), Recording)
    with pytest.raises(SplashbenchError, match=r"board is a folder, other chapters"):
        open_recording([folder, tmp_path / "GX010001.MP4"])


def _empty(folder: Path) -> None:
    for path in folder.iterdir():
        path.unlink()


def _truncate(folder: Path) -> None:
    data = (folder / "a.png").read_bytes()
    (folder / "a.png").write_bytes(data[: len(data) // 2])


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (_empty, r"board holds no JPEG or PNG photographs; copy them there"),
        (lambda folder: photograph(folder / "d.png", size=(24, 40)), r"d\.png is 24x40, a\.png is 40x24; a folder"),
        (lambda folder: photograph(folder / "d.jpg", orientation=6), r"d\.jpg is 24x40, a\.png is 40x24"),
        (lambda folder: (folder / "d.jpg").write_bytes(b"rubbish"), r"d\.jpg is not a readable image"),
        (_truncate, r"a\.png is cut short or damaged"),
        (lambda folder: (folder / "d.jpg").mkdir(), r"d\.jpg is a folder, not a file"),
        (lambda folder: (folder / "d.jpg").symlink_to("/etc/hostname"), r"d\.jpg is a link; copy the photograph"),
    ],
)
def test_faults_are_one_line_naming_the_file(folder: Path, spoil: Callable[[Path], object], message: str) -> None:
    spoil(folder)
    with pytest.raises(SplashbenchError, match=message) as caught:
        list(Stills([folder]).frames())
    assert "\n" not in str(caught.value)


def test_a_folder_has_a_bounded_number_of_photographs(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("splashbench.prepare.video.stills.MAX_PHOTOGRAPHS", 2)
    with pytest.raises(SplashbenchError, match="more than 2 photographs"):
        _ = Stills([folder]).info
