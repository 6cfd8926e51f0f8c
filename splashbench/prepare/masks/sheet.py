"""A contact sheet of masks for a person's eye: cameras in rows, instants in columns, each mask's outline on its image.

A mask is marked in red, with the reason, where it is empty, where its area cannot be right (`masks.mask_health`), and
where other views see liquid that it misses (`splashbench.observe.failures`, for a calibrated scene). Each column stands
for an equal part of the sequence and shows the instant in it at which most masks fail, else the middle one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from splashbench.errors import SplashbenchError
from splashbench.files import read_gray, read_image
from splashbench.prepare.masks.comparison import SCENE_MARK, MaskSet
from splashbench.prepare.masks.drawing import FAULT, GREY, PAPER, outlined, thumbnail, write_line
from splashbench.prepare.masks.provider import MASK_THRESHOLD, Mask, mask_health
from splashbench.progress import track

Faults = dict[str, dict[int, str]]  # camera -> position of a frame -> reason

EMPTY = "empty"
FLOODED = "covers nearly everything"
FLICKERING = "far less than before and after"
VANISHED = "empty, but not before and after"
MISSED = "misses what other views see"
_IMAGE_ENDINGS = (".png", ".jpg", ".jpeg", ".PNG", ".JPG")
_LABEL, _HEADER, _TITLE, _CAPTION, _GAP, _BORDER = 118, 22, 34, 18, 6, 3
CELL_WIDTH = 260  # pixels
_MAX_CELLS = 2000


@dataclass(frozen=True, eq=False)
class SheetCell:
    """One mask [H, W] on its image [H, W, 3], sRGB uint8; `fault` is the reason why it cannot be right, or empty."""

    image: NDArray[np.uint8]
    mask: Mask
    fault: str = ""


def small_cell(image: NDArray[np.uint8], mask: Mask, fault: str = "") -> SheetCell:
    """A cell of an image [H, W, 3] and its mask [H, W], shrunk to twice a cell's width at most."""
    return SheetCell(*thumbnail(image, mask, min(2 * CELL_WIDTH, image.shape[1]), image.shape[0]), fault)


def mask_faults(
    areas: Mapping[str, Sequence[int]], n_pixels: Mapping[str, int], missed: Mapping[str, Sequence[int]] | None = None
) -> Faults:
    """What is wrong with each camera's masks, by their areas in pixels in order of time.

    n_pixels: of an image of each camera. missed: camera -> frames whose mask misses liquid that other views see.
    """
    faults: Faults = {}
    for camera, sizes in areas.items():
        health = mask_health(sizes, n_pixels[camera])
        # Later ones say more.
        reasons = dict.fromkeys((missed or {}).get(camera, ()), MISSED)
        reasons |= dict.fromkeys(health.flooded, FLOODED) | dict.fromkeys(health.flickering, FLICKERING)
        reasons |= {t: VANISHED if t in health.flickering else EMPTY for t in health.empty}
        faults[camera] = {t: reasons[t] for t in sorted(reasons)}
    return faults


def sheet_times(n_frames: int, faults: Faults, columns: int) -> list[int]:
    """The frames to show: one of each equal part of the sequence, where most masks fail, else the middle one.

    Masks that are merely empty count least, as there is no liquid before it comes.
    """
    failures = np.zeros(n_frames)
    for reasons in faults.values():
        for t, reason in reasons.items():
            failures[t] += 0.01 if reason == EMPTY else 1.0
    chosen = []
    for part in np.array_split(np.arange(n_frames), min(columns, n_frames)):
        worst = part[failures[part] == failures[part].max()]
        middle = part[len(part) // 2]
        chosen.append(int(worst[np.argmin(np.abs(worst - middle))]))
    return chosen


def mask_sheet(
    title: str,
    columns: Sequence[str],
    rows: Mapping[str, Sequence[SheetCell]],
    notes: Mapping[str, str] | None = None,
    cell_width: int = CELL_WIDTH,
) -> NDArray[np.uint8]:
    """Draw the sheet, RGB uint8 [H, W, 3].

    Args:
        columns: what stands above each column.
        rows: camera -> its cells, one per column. Images of a row have one shape.
        notes: camera -> a few words under its name.
        cell_width: of a cell, in pixels; images are scaled into it.
    """
    if not rows or not columns or any(len(cells) != len(columns) for cells in rows.values()):
        raise ValueError("every row needs one cell per column, and there must be a row and a column")
    if len(rows) * len(columns) > _MAX_CELLS:
        raise ValueError(f"{len(rows)} x {len(columns)} cells are more than {_MAX_CELLS}")
    shapes = [cells[0].image.shape for cells in rows.values()]
    cell_height = round(cell_width * max(min(1.0, height / width) for height, width, _ in shapes))
    step = cell_width + 2 * _BORDER + _GAP
    drawn = [
        np.full((_TITLE, _LABEL + step * len(columns), 3), PAPER, np.uint8),
        np.full((_HEADER, _LABEL + step * len(columns), 3), PAPER, np.uint8),
    ]
    write_line(drawn[0], 8, 8, title, size=15, bold=True, room=drawn[0].shape[1] - 16)
    for number, name in enumerate(columns):
        write_line(drawn[1], _LABEL + step * number + _BORDER, 3, name, room=cell_width)
    for camera, cells in rows.items():
        label = np.full((cell_height + 2 * _BORDER + _CAPTION, _LABEL, 3), PAPER, np.uint8)
        write_line(label, 8, _BORDER, f"camera {camera}", bold=True, room=_LABEL - 12)
        for number, line in enumerate((notes or {}).get(camera, "").split("\n")):
            write_line(label, 8, _BORDER + 18 + 15 * number, line, size=11, colour=GREY, room=_LABEL - 12)
        gap = np.full((label.shape[0], _GAP, 3), PAPER, np.uint8)
        parts = [label]
        for cell in cells:
            parts += [_drawn(cell, cell_width, cell_height), gap]
        drawn.append(np.concatenate(parts, axis=1))
    return np.concatenate(drawn)


def _drawn(cell: SheetCell, width: int, height: int) -> NDArray[np.uint8]:
    """A cell with its border and, under it, the reason for a fault."""
    canvas = np.full((height + 2 * _BORDER + _CAPTION, width + 2 * _BORDER, 3), PAPER, np.uint8)
    image, mask = thumbnail(cell.image, cell.mask, width, height)
    picture = outlined(image, mask)
    if cell.fault:
        canvas[: picture.shape[0] + 2 * _BORDER, : picture.shape[1] + 2 * _BORDER] = FAULT
        caption = canvas[picture.shape[0] + 2 * _BORDER :][:_CAPTION]
        write_line(caption, _BORDER, 1, cell.fault, size=12, colour=FAULT, bold=True, room=width)
    canvas[_BORDER : _BORDER + picture.shape[0], _BORDER : _BORDER + picture.shape[1]] = picture
    return canvas


def sheet_of_set(
    masks: MaskSet, columns: int = 8, images: Path | None = None, cell_width: int = CELL_WIDTH
) -> tuple[NDArray[np.uint8], Faults, list[str]]:
    """The sheet of a scene's masks, or of a folder of masks.

    images: folder with <camera>/<frame>.png or .jpg; that of the scene by default, else black.
    Returns the sheet, what is wrong with which frame, and remarks: what could not be judged, and why.
    Raises SplashbenchError for files that cannot be read.
    """
    folder = images if images is not None else (Path(masks.images) if masks.images else None)
    frames = sorted({frame for files in masks.files.values() for frame in files})
    areas: dict[str, list[int]] = {}
    shapes: dict[str, tuple[int, int]] = {}
    for camera, files in track(masks.files.items(), f"masks of {masks.name}"):
        areas[camera] = []
        for frame in frames:
            mask = _read_mask(files.get(frame), shapes.get(camera))
            if frame in files and shapes.setdefault(camera, mask.shape) != mask.shape:
                raise SplashbenchError(
                    f"{files[frame]} is {mask.shape[1]}x{mask.shape[0]}, others of camera {camera} are"
                    f" {shapes[camera][1]}x{shapes[camera][0]}; bring them to one size"
                )
            areas[camera].append(int(mask.sum()))
    missed, remarks = _missed(masks, frames)
    faults = mask_faults(areas, {camera: shape[0] * shape[1] for camera, shape in shapes.items()}, missed)
    times = sheet_times(len(frames), faults, columns)
    if len(masks.files) * len(times) > _MAX_CELLS:
        raise SplashbenchError(
            f"{masks.folder}: {len(masks.files)} cameras with {len(times)} timesteps each are more than the "
            f"{_MAX_CELLS} pictures that a sheet has room for; give fewer --columns, or a folder of fewer cameras"
        )
    rows = {}
    for camera, files in track(masks.files.items(), f"sheet of {masks.name}"):
        cells = []
        for t in times:
            mask = _read_mask(files.get(frames[t]), shapes[camera])
            image = _read_frame(folder, camera, frames[t], shapes[camera])
            cells.append(small_cell(image, mask, faults[camera].get(t, "")))
        rows[camera] = cells
    sheet = mask_sheet(
        f"{masks.name}: masks of {len(rows)} cameras, {len(frames)} frames",
        [f"{t}: {frames[t]}" if frames[t] != f"{t:06d}" else f"frame {t}" for t in times],
        rows,
        {camera: fault_note(faults[camera], len(frames)) for camera in rows},
        cell_width,
    )
    return sheet, faults, remarks


def fault_note(reasons: Mapping[int, str], n_frames: int) -> str:
    """A camera's faults in a few words, on up to three lines."""
    empty = sum(reason == EMPTY for reason in reasons.values())
    lines = [f"of {n_frames} masks", f"{empty} empty", f"{len(reasons) - empty} failed"]
    return "\n".join(lines) if reasons else f"{n_frames} masks,\nno fault seen"


def _read_mask(path: str | None, shape: tuple[int, int] | None) -> Mask:
    if path is None:  # no liquid, as in a folder of masks
        return np.zeros(shape or (1, 1), bool)
    return np.asarray(read_gray(Path(path)) >= MASK_THRESHOLD)


def _read_frame(folder: Path | None, camera: str, frame: str, shape: tuple[int, int]) -> NDArray[np.uint8]:
    path = find_image(folder, camera, frame)
    if path is None:
        return np.zeros((*shape, 3), np.uint8)
    image = read_image(path)
    if image.shape[:2] != shape:
        raise SplashbenchError(
            f"{path} is {image.shape[1]}x{image.shape[0]}, its mask {shape[1]}x{shape[0]}; give them of one size"
        )
    return image


def find_image(folder: Path | None, camera: str, frame: str) -> Path | None:
    """The image FOLDER/<camera>/<frame> with any of the usual endings; None where there is none."""
    if folder is None:
        return None
    candidates = (folder / camera / f"{frame}{ending}" for ending in _IMAGE_ENDINGS)
    return next((path for path in candidates if path.is_file()), None)


def _missed(masks: MaskSet, frames: Sequence[str]) -> tuple[dict[str, list[int]], list[str]]:
    """Camera -> frames whose mask misses what the others see; and why that could not be told."""
    directory = Path(masks.folder)
    if not (directory / SCENE_MARK).is_file():
        return {}, ["masks are not compared across views: this is no calibrated scene"]
    from splashbench.observe import Silhouettes, distrust_failed_masks
    from splashbench.scene import Scene

    try:
        scene = Scene.open(directory)
        views = (*scene.train, *scene.test)
        failed = distrust_failed_masks(Silhouettes(scene, views))
    except SplashbenchError as error:
        return {}, [f"masks are not compared across views: {error}"]
    place = {frame: t for t, frame in enumerate(frames)}
    return {
        view: [place[scene.frames[t]] for t in np.flatnonzero(failed[:, number]) if scene.frames[t] in place]
        for number, view in enumerate(views)
    }, []
