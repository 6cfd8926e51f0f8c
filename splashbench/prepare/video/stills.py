"""Photographs in place of a video: a folder of them is read like a recording whose frames they are.

Boards and static scenes are often photographed rather than filmed (paper Sec. 3, "Capture and calibration"). Nothing
here has a clock, so photographs can stand for any recording but the pour.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splashbench.errors import SplashbenchError
from splashbench.files import image_size
from splashbench.prepare.video.recording import Floats, Recording

MAX_PHOTOGRAPHS = 5000
_SUFFIXES = (".jpg", ".jpeg", ".png")
_FORMATS = ("JPEG", "PNG")
_ORIENTATION = 0x0112  # EXIF tag
_ON_THEIR_SIDE = (5, 6, 7, 8)  # orientations that exchange width and height


@dataclass(frozen=True)
class StillsInfo:
    """Size of the photographs as shown, after their orientation tag, and how many there are."""

    width: int
    height: int
    n_frames: int


class Stills:
    """The photographs (JPEG and PNG) of one or more folders, in order of their names."""

    def __init__(self, paths: Iterable[Path]) -> None:
        self.paths = tuple(Path(path) for path in paths)
        if not self.paths:
            raise ValueError("photographs need at least one folder")

    @cached_property
    def files(self) -> tuple[Path, ...]:
        """Every photograph. Raises SplashbenchError where a folder holds none, or too many."""
        files: list[Path] = []
        for folder in self.paths:
            try:
                photographs = sorted(path for path in folder.iterdir() if path.suffix.lower() in _SUFFIXES)
            except OSError as error:
                raise SplashbenchError(f"{folder} cannot be read as a folder ({error.strerror}); restore it") from None
            visible = [path for path in photographs if not path.name.startswith(".")]
            if not visible:
                raise SplashbenchError(f"{folder} holds no JPEG or PNG photographs; copy them there")
            for path in visible:
                if path.is_symlink():
                    raise SplashbenchError(f"{path} is a link; copy the photograph itself into the folder")
            files += visible
        if len(files) > MAX_PHOTOGRAPHS:
            raise SplashbenchError(f"{self.paths[0]} holds more than {MAX_PHOTOGRAPHS} photographs; choose some")
        return tuple(files)

    @cached_property
    def info(self) -> StillsInfo:
        """Facts of all photographs, from their headers. Raises SplashbenchError where their sizes differ."""
        first: tuple[int, int] | None = None
        for path in self.files:
            size = _shown_size(path)
            first = first or size
            if size != first:
                raise SplashbenchError(
                    f"{path} is {size[0]}x{size[1]}, {self.files[0].name} is {first[0]}x{first[1]}; a folder holds the"
                    " photographs of one camera in one mode"
                )
        assert first is not None
        return StillsInfo(first[0], first[1], len(self.files))

    @property
    def frame_times(self) -> Floats:
        """The photographs' numbers [N] in place of times: one follows the other, at no known instant."""
        return np.arange(len(self.files), dtype=np.float64)

    def frames(self, indices: Iterable[int] | None = None) -> Iterator[tuple[int, NDArray[np.uint8]]]:
        """Yield (index, sRGB uint8 [H, W, 3]) in increasing order: all photographs, or those of `indices`, each once.

        Raises SplashbenchError when one is damaged or differs in size from the others.
        """
        total = self.info.n_frames
        chosen = range(total) if indices is None else sorted(set(indices))
        if len(chosen) and not 0 <= chosen[0] <= chosen[-1] < total:
            raise ValueError(f"frame indices must lie in 0..{total - 1}")
        for index in chosen:
            yield int(index), _read(self.files[index])

    def luma(
        self, width: int, first: int = 0, last: int | None = None, keyframes: bool = False
    ) -> Iterator[tuple[int, NDArray[np.uint8]]]:
        """Yield (index, luma uint8 [h, width]) of photographs first..last, shrunk by area.

        Every photograph is a key frame, so `keyframes` changes nothing.
        """
        import cv2

        height = max(1, round(self.info.height * width / self.info.width))
        stop = self.info.n_frames if last is None else min(last + 1, self.info.n_frames)
        for index, image in self.frames(range(max(first, 0), stop)):
            grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
            yield index, np.asarray(cv2.resize(grey, (width, height), interpolation=cv2.INTER_AREA), np.uint8)


def open_recording(paths: Iterable[Path]) -> Recording | Stills:
    """The video files of one recording, or its folders of photographs.

    Raises SplashbenchError where `paths` mixes the two.
    """
    listed = tuple(Path(path) for path in paths)
    folders = [path for path in listed if path.is_dir()]
    if folders and len(folders) < len(listed):
        raise SplashbenchError(
            f"{folders[0]} is a folder, other chapters of the same recording are files; list either videos or folders"
            " of photographs"
        )
    return Stills(listed) if folders else Recording(listed)


def _opened(path: Path) -> Any:
    from PIL import Image

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", Image.DecompressionBombWarning)  # `image_size` has a lower limit of its own
        return Image.open(path, formats=_FORMATS)


def _damaged(path: Path, error: Exception) -> SplashbenchError:
    return SplashbenchError(f"{path} is cut short or damaged ({error}); copy it from the camera again")


def _shown_size(path: Path) -> tuple[int, int]:
    """(width, height) after the orientation tag; refuses what is no plain image file of bounded size."""
    width, height = image_size(path)
    try:
        with _opened(path) as image:
            turned = image.getexif().get(_ORIENTATION) in _ON_THEIR_SIDE
    except Exception as error:  # Pillow lets whatever a broken EXIF block causes through
        raise _damaged(path, error) from None
    return (height, width) if turned else (width, height)


def _read(path: Path) -> NDArray[np.uint8]:
    """The photograph as it is shown: sRGB uint8 [H, W, 3]."""
    from PIL import ImageOps

    image_size(path)
    try:
        with _opened(path) as image:
            return np.asarray(ImageOps.exif_transpose(image).convert("RGB"))
    except Exception as error:  # as above
        raise _damaged(path, error) from None
