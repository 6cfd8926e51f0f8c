"""Where liquid masks come from, and which of them cannot be right.

A provider gives masks of the raw, distorted frames, by camera and source frame; `prepare` then undistorts them
exactly like the images. The paper starts from SAM3 and refines by hand (Sec. 3, "Annotations and protocol"): such
masks come in through `FolderMasks`. `background` makes masks without any annotation, `sam3` asks the model. 8.6% of
the raw SAM3 masks in the paper are empty (Sec. S1.3), so failed masks are looked for whatever their source.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from splashbench.errors import SplashbenchError
from splashbench.files import read_gray
from splashbench.prepare.stage_cache import facts_of

# Liquid that fills more than this share of a frame is a mask of everything.
MAX_AREA_SHARE = 0.6
# Liquid does not vanish for one sampled frame and come back: an area this small beside both neighbours' is a failure.
FLICKER_SHARE = 0.2
MASK_THRESHOLD = 128

Mask = NDArray[np.bool_]


class MaskProvider(Protocol):
    """Anything that can say where the liquid is."""

    name: str

    def masks(self, camera: str, indices: Sequence[int]) -> Iterator[tuple[int, Mask]]:
        """Yield (source frame index, mask [H, W] in raw geometry) in the order of `indices`, which increase."""
        ...

    def made_from(self, camera: str, indices: Sequence[int]) -> Mapping[str, Any]:
        """What the masks of these frames depend on besides the recording: where it is the same, so are they.

        Of what `stages` can store: numbers, texts, lists, files as `stages.facts_of` has them.
        """
        ...


class FolderMasks:
    """Masks made elsewhere: FOLDER/<camera>/<source frame:06d>.png, white where there is liquid, raw geometry.

    A frame without a file has no liquid; a camera without a single file for the frames asked is an error, as is a
    mask of another size than the recording.
    """

    name = "folder"

    def __init__(self, folder: Path, sizes: dict[str, tuple[int, int]]) -> None:
        self.folder = Path(folder)
        self.sizes = sizes  # camera -> (width, height)

    def masks(self, camera: str, indices: Sequence[int]) -> Iterator[tuple[int, Mask]]:
        """See `MaskProvider.masks`."""
        width, height = self.sizes[camera]
        paths = {index: self.folder / camera / f"{index:06d}.png" for index in indices}
        if not any(path.is_file() for path in paths.values()):
            first = paths[indices[0]]
            raise SplashbenchError(
                f"{first.parent}: no mask for any of the {len(indices)} source frames of camera {camera};"
                f" masks are named like {first.name}"
            )
        for index, path in paths.items():
            if not path.is_file():
                yield index, np.zeros((height, width), bool)
                continue
            yield index, read_raw_mask(path, width, height)

    def made_from(self, camera: str, indices: Sequence[int]) -> Mapping[str, Any]:
        """See `MaskProvider.made_from`: the files."""
        paths = (self.folder / camera / f"{index:06d}.png" for index in indices)
        return {"masks": facts_of(path for path in paths if path.is_file())}


def read_raw_mask(path: Path, width: int, height: int) -> Mask:
    """A mask file in raw geometry, [H, W]. Raises SplashbenchError when its size is not that of the recording."""
    mask = read_gray(path)
    if mask.shape != (height, width):
        raise SplashbenchError(
            f"{path} is {mask.shape[1]}x{mask.shape[0]}, the recording is {width}x{height};"
            " give masks of the raw frames"
        )
    return mask >= MASK_THRESHOLD


@dataclass(frozen=True)
class MaskHealth:
    """What is suspicious about one camera's masks: positions (0..T-1) of the frames concerned."""

    empty: list[int]  # no liquid at all; may be true before it enters the view
    flooded: list[int]  # liquid nearly everywhere
    flickering: list[int]  # far less liquid than just before and just after

    @property
    def failed(self) -> list[int]:
        """Frames whose mask cannot be right: flooded or flickering (an empty one between others flickers)."""
        return sorted(set(self.flooded) | set(self.flickering))


def mask_health(areas: Sequence[int], n_pixels: int) -> MaskHealth:
    """Judge one camera's masks by their areas in pixels, a frame each, in order of time."""
    empty = [t for t, area in enumerate(areas) if area == 0]
    flooded = [t for t, area in enumerate(areas) if area > MAX_AREA_SHARE * n_pixels]
    flickering = [t for t in range(1, len(areas) - 1) if areas[t] < FLICKER_SHARE * min(areas[t - 1], areas[t + 1])]
    return MaskHealth(empty, flooded, flickering)
