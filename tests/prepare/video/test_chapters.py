"""Chapters out of order, or with one missing, are refused by name, timecode or time of creation."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from splashbench.errors import SplashbenchError
from splashbench.prepare.media.container import VideoInfo
from splashbench.prepare.video.chapters import check_chapters
from splashbench.prepare.video.recording import Recording
from splashbench.synth.recording.video import write_recording


def facts(timecode: str | None = None, created: str | None = None, seconds: float = 600.0) -> VideoInfo:
    return VideoInfo(1920, 1080, 59.94, 36000, seconds, 0.0, True, "hevc", timecode, 0.0, created)


def check(**files: VideoInfo) -> None:
    check_chapters([Path("cameras/3") / f"{name}.MP4" for name in files], list(files.values()))


GOOD = [
    {"GX010003": facts(), "GX020003": facts(), "GX030003": facts()},
    {"GOPR0003": facts(), "GP010003": facts(), "GP020003": facts()},
    {"GX020003": facts(), "GX030003": facts()},  # the pour is in the later chapters
    {"a": facts("10:00:00:00"), "b": facts("10:10:00:30")},
    {"a": facts("23:55:00:00"), "b": facts("00:05:00;02")},  # over midnight, drop frames
    {"a": facts("10:00:00:00"), "b": facts("10:00:00:00")},  # as converters write them
    {"a": facts(None, "2024-05-04T10:00:00.000000Z"), "b": facts(None, "2024-05-04T10:00:00.000000Z")},
    {
        "GX010003": facts(None, "2024-05-04T11:00:00Z"),
        "GX020003": facts(None, "2024-05-04T10:00:00Z"),
    },  # converted later
    {"a": facts("nonsense", "1904"), "b": facts(None, "yesterday")},
]


@pytest.mark.parametrize("files", GOOD)
def test_chapters_in_order_pass(files: dict[str, VideoInfo]) -> None:
    check(**files)


BAD = [
    ({"GX020003": facts(), "GX010003": facts()}, r"GX010003\.MP4 cannot follow GX020003\.MP4: it is chapter 1, the"
     r" other 2; list them in order in session.toml: GX010003\.MP4, GX020003\.MP4"),
    ({"GX010003": facts(), "GX030003": facts()}, "chapter 2 of recording 0003 is missing between them; copy the"),
    ({"GX010003": facts(), "GX020004": facts()}, "it is of recording 0004, not 0003; .*list one recording only"),
    ({"b": facts("10:10:00:00"), "a": facts("10:00:00:00")}, r"timecode 10:00:00:00 is 1200.0 s before the other's end;"
     r" list them in order in session.toml: a\.MP4, b\.MP4"),
    ({"a": facts("10:00:00:00"), "c": facts("10:20:00:00")}, "10:20:00:00 is 600.0 s after the other's end; co"),
    ({"b": facts(None, "2024-05-04T10:10:00Z"), "a": facts(None, "2024-05-04T10:00:00Z")}, "created 600 s before the"),
]  # fmt: skip


@pytest.mark.parametrize(("files", "pattern"), BAD)
def test_what_does_not_follow_is_named(files: dict[str, VideoInfo], pattern: str) -> None:
    with pytest.raises(SplashbenchError, match=pattern):
        check(**files)


def test_a_chapter_that_was_copied_twice_is_refused() -> None:
    with pytest.raises(SplashbenchError, match="it is chapter 1, the other 1"):
        check_chapters([Path("card/GX010003.MP4"), Path("copy/GX010003.MP4")], [facts(), facts()])


def test_files_with_stamps_are_refused_in_the_wrong_order(tmp_path: Path) -> None:
    """As the camera wrote them, but renamed by whoever copied them."""
    for name, timecode in (("first.mp4", "10:00:00:00"), ("second.mp4", "10:00:02:00")):
        frames = (np.full((36, 64, 3), 40 + k, np.uint8) for k in range(60))
        write_recording(tmp_path / name, frames, 30, np.zeros(96000, np.float32), timecode=timecode)
    assert len(Recording([tmp_path / "first.mp4", tmp_path / "second.mp4"]).headers) == 2
    with pytest.raises(SplashbenchError, match=r"first\.mp4 cannot follow second\.mp4: its timecode 10:00:00:00 is 4"):
        _ = Recording([tmp_path / "second.mp4", tmp_path / "first.mp4"]).info
