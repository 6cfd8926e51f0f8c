"""Two sets of liquid masks compared, as the paper compares raw SAM3 masks with the refined ones (Sec. S1.3).

Of a raw mask R and a refined mask A of one frame of one camera, with union U = R | A:

    IoU = |R & A| / |U|,    added = |A \\ R| / |U|,    removed = |R \\ A| / |U|,

so IoU + added + removed = 1. The paper's figures are means over masks: its mean IoU of 0.772, 20.1% "of the union
added" and 2.7% removed add up to one, as totals over all pixels would not.

A pair without any liquid has no IoU and is left out of these; `n_blank` counts it. The empty share is that of raw masks
without a pixel, over all masks. Touched pixels (|A \\ R| + |R \\ A|) and the coverage of either are shares of
the frame, over all frames.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from splashbench.errors import SplashbenchError
from splashbench.files import read_gray
from splashbench.prepare.masks.provider import MASK_THRESHOLD, Mask
from splashbench.progress import track
from splashbench.scene.neurofluid import is_neurofluid

SCENE_MARK = "train_meta.json"
# A folder with more is none of masks; reading them would take days.
MAX_MASKS = 1_000_000


@dataclass(frozen=True)
class MaskSet:
    """Where the masks of one scene lie. `files`: camera -> frame name -> file; `images`: ims/ of a scene, or None."""

    name: str
    folder: str
    files: dict[str, dict[str, str]]
    images: str | None


@dataclass(frozen=True)
class MaskPair:
    """One frame of one camera in both sets: areas and changes in pixels."""

    camera: str
    frame: str
    n_pixels: int
    raw_area: int
    refined_area: int
    added: int
    removed: int

    @property
    def union(self) -> int:
        """Pixels that are liquid in either."""
        return self.raw_area + self.added

    @property
    def iou(self) -> float | None:
        """Intersection over union; None where neither has liquid."""
        return (self.raw_area - self.removed) / self.union if self.union else None


@dataclass(frozen=True)
class MaskChange:
    """The paper's figures over some pairs; shares in 0..1, NaN where nothing has liquid."""

    n_masks: int
    n_blank: int
    mean_iou: float
    median_iou: float
    added_share: float
    removed_share: float
    empty_share: float
    touched_share: float
    raw_coverage: float
    refined_coverage: float


@dataclass(frozen=True)
class MaskComparison:
    """Two mask sets of one scene. `pairs` by camera, in the order of frames."""

    scene: str
    raw: MaskSet
    refined: MaskSet
    pairs: dict[str, list[MaskPair]]

    @property
    def all_pairs(self) -> list[MaskPair]:
        """Of all cameras."""
        return [pair for pairs in self.pairs.values() for pair in pairs]


def find_mask_sets(folder: Path) -> list[MaskSet]:
    """The mask sets in `folder`: of a scene (its seg/), of masks as <camera>/<frame>.png, or of a folder of either.

    Raises SplashbenchError where there are none.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise SplashbenchError(f"{folder} is not a folder; give a scene, or a folder of masks <camera>/<frame>.png")
    # Photographs of a view lie as masks do elsewhere; masks/ beside such a file is of an exported scene.
    places = [folder] if folder.name == "masks" else [folder, folder.parent]
    if is_neurofluid(folder) or any(any(place.glob("transforms_*.json")) for place in places):
        raise SplashbenchError(
            f"{folder} is of a scene in NeuroFluid's layout, which keeps its masks within its photographs; "
            "give a folder of masks <camera>/<frame>.png"
        )
    single = _mask_set(folder)
    if single is not None:
        return [single]
    inner = [_mask_set(path) for path in sorted(folder.iterdir()) if path.is_dir()]
    sets = [mask_set for mask_set in inner if mask_set is not None]
    if not sets:
        raise SplashbenchError(
            f"{folder} has no masks; give a scene, a folder of masks <camera>/<frame>.png, or a folder of these"
        )
    return sets


def _mask_set(folder: Path) -> MaskSet | None:
    is_scene = (folder / SCENE_MARK).is_file()
    root = folder / "seg" if is_scene else folder
    if is_scene and not root.is_dir():
        raise SplashbenchError(f"{root} is missing; a scene has its masks there")
    files = {}
    for camera in sorted(path for path in root.iterdir() if path.is_dir()):
        masks = {path.stem: str(path) for path in sorted(camera.glob("*.png")) if path.is_file()}
        if masks:
            files[camera.name] = masks
    if sum(map(len, files.values())) > MAX_MASKS:
        raise SplashbenchError(f"{root} has more than {MAX_MASKS} files; give the masks of fewer scenes at once")
    if not files:
        return None
    images = folder / "ims"
    return MaskSet(folder.resolve().name, str(folder), files, str(images) if is_scene and images.is_dir() else None)


def compare_mask_sets(raw: MaskSet, refined: MaskSet) -> MaskComparison:
    """Compare all masks of one scene. A frame that one set lacks has no liquid there, as in a folder of masks.

    Raises SplashbenchError where the sets have other cameras, no frame in common, or masks of different sizes.
    """
    for one, other in ((raw, refined), (refined, raw)):
        missing = sorted(set(one.files) - set(other.files))
        if missing:
            raise SplashbenchError(
                f"{other.folder} has no masks of camera {missing[0]}, which {one.folder} has; compare the same cameras"
            )
    jobs = []
    for camera, masks in raw.files.items():
        if not set(masks) & set(refined.files[camera]):
            raise SplashbenchError(
                f"{refined.folder}: no frame of camera {camera} has the name of one in {raw.folder}"
                f" (such as {min(masks)}.png); name both sets alike"
            )
        jobs += [(camera, frame) for frame in sorted(set(masks) | set(refined.files[camera]))]
    pairs: dict[str, list[MaskPair]] = {camera: [] for camera in raw.files}
    for camera, frame in track(jobs, f"comparing masks of {refined.name}"):
        pairs[camera].append(_compare(camera, frame, *read_pair(raw, refined, camera, frame)))
    return MaskComparison(refined.name, raw, refined, pairs)


def compare_folders(raw: Path, refined: Path) -> Iterator[MaskComparison]:
    """Compare what two folders hold (see `find_mask_sets`), scene by scene; several scenes go by name.

    Raises SplashbenchError where the scenes differ.
    """
    ours, theirs = find_mask_sets(raw), find_mask_sets(refined)
    if len(ours) == len(theirs) == 1:
        yield compare_mask_sets(ours[0], theirs[0])
        return
    by_name = {mask_set.name: mask_set for mask_set in theirs}
    names = {mask_set.name for mask_set in ours}
    for folder, missing in ((refined, names - set(by_name)), (raw, set(by_name) - names)):
        if missing:
            raise SplashbenchError(f"{folder} lacks the scene {min(missing)}, which the other has; compare the same")
    for mask_set in ours:
        yield compare_mask_sets(mask_set, by_name[mask_set.name])


def read_pair(raw: MaskSet, refined: MaskSet, camera: str, frame: str) -> tuple[Mask, Mask]:
    """Both masks [H, W] of one frame; one that is missing is empty."""
    paths = [mask_set.files[camera].get(frame) for mask_set in (raw, refined)]
    masks = [None if path is None else read_gray(Path(path)) >= MASK_THRESHOLD for path in paths]
    shape = next(mask.shape for mask in masks if mask is not None)
    first, second = (np.zeros(shape, bool) if mask is None else mask for mask in masks)
    if first.shape != second.shape:
        raise SplashbenchError(
            f"{paths[0]} is {first.shape[1]}x{first.shape[0]}, but {paths[1]} is {second.shape[1]}x{second.shape[0]};"
            " bring both to one size"
        )
    return first, second


def _compare(camera: str, frame: str, raw: Mask, refined: Mask) -> MaskPair:
    return MaskPair(
        camera,
        frame,
        n_pixels=raw.size,
        raw_area=int(raw.sum()),
        refined_area=int(refined.sum()),
        added=int((refined & ~raw).sum()),
        removed=int((raw & ~refined).sum()),
    )


def mask_change(pairs: Sequence[MaskPair]) -> MaskChange:
    """The figures over `pairs`, of which there is at least one."""
    wet = [pair for pair in pairs if pair.union]
    ious = [pair.iou for pair in wet if pair.iou is not None]

    def mean(values: Sequence[float]) -> float:
        return float(np.mean(values)) if len(values) else math.nan

    return MaskChange(
        n_masks=len(pairs),
        n_blank=len(pairs) - len(wet),
        mean_iou=mean(ious),
        median_iou=float(np.median(ious)) if ious else math.nan,
        added_share=mean([pair.added / pair.union for pair in wet]),
        removed_share=mean([pair.removed / pair.union for pair in wet]),
        empty_share=mean([float(pair.raw_area == 0) for pair in pairs]),
        touched_share=mean([(pair.added + pair.removed) / pair.n_pixels for pair in pairs]),
        raw_coverage=mean([pair.raw_area / pair.n_pixels for pair in pairs]),
        refined_coverage=mean([pair.refined_area / pair.n_pixels for pair in pairs]),
    )


def change_rows(comparisons: Sequence[MaskComparison]) -> Mapping[tuple[str, str], MaskChange]:
    """(scene, camera) -> figures; "all" stands for all cameras of a scene and, with several scenes, for all scenes."""
    rows: dict[tuple[str, str], MaskChange] = {}
    for comparison in comparisons:
        for camera, pairs in comparison.pairs.items():
            rows[comparison.scene, camera] = mask_change(pairs)
        rows[comparison.scene, "all"] = mask_change(comparison.all_pairs)
    if len(comparisons) > 1:
        rows["all", "all"] = mask_change([pair for comparison in comparisons for pair in comparison.all_pairs])
    return rows


def worst_pairs(comparison: MaskComparison, count: int) -> list[MaskPair]:
    """The pairs with the least IoU, at most one in ten frames of a camera, the worst first."""
    chosen: list[MaskPair] = []
    order = {(pair.camera, pair.frame): n for pairs in comparison.pairs.values() for n, pair in enumerate(pairs)}
    candidates = [pair for pair in comparison.all_pairs if pair.iou is not None and pair.iou < 1]
    for pair in sorted(candidates, key=lambda pair: (pair.iou, -pair.union, pair.camera, pair.frame)):
        place = order[pair.camera, pair.frame]
        spread = len(comparison.pairs[pair.camera]) // 10
        near = (order[c.camera, c.frame] - place for c in chosen if c.camera == pair.camera)
        if all(abs(gap) > spread for gap in near):
            chosen.append(pair)
        if len(chosen) == count:
            break
    return chosen
