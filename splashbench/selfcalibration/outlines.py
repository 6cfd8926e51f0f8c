"""Where photographs say that liquid ends, against where masks do.

Two things tell a pixel of liquid: how it differs from the clean plate, and its colour. Histograms of both are counted
deep inside a camera's masks and far outside of them, where masks are hardly ever wrong; their likelihood ratio tells
the pixels between. What it says stands for the masks in the next round, so that plates and histograms get purer. Masks
that end elsewhere, miss parts or show something else are replaced by what is said in the end.

Photographs do not tell everywhere: clear liquid before an even wall looks like the wall. So they are asked three times,
beginning with the masks, with less and with more than these. Where the answers do not meet, masks stay as they are. And
where outlines are longer than what photographs can show: these are blurred or compressed then, and the masks are not.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from splashbench.background.median import masked_median
from splashbench.observe.mask_distance import outline_distance
from splashbench.parallel import each
from splashbench.scene.frames import spread_frames
from splashbench.scene.scene import TrainingScene

Images = NDArray[np.uint8]
Masks = NDArray[np.bool_]

#: Masks are looked at in at most so many frames of each camera.
FRAMES = 16
# And with no side longer than this, in pixels.
_SIDE = 480
# Rounds to see whether something is wrong, and to say what is right.
_ROUNDS, _ROUNDS_MORE = 3, 5
# Bins of a channel; pixels that every bin has besides, and the width by which bins are smoothed.
_BINS, _BESIDE, _SMOOTHED = 16, 0.002, 0.8
# No bin says more than this, in nats; the sum of both says liquid above this much.
_MOST, _FROM = 6.0, 0.3
#: Colour alone has to say so much, in nats.
SURE = 2.0
# Deep inside is more than so many pixels, and in the first round deeper than this share of all that is inside: of masks
# that reach far beyond the liquid only the innermost is liquid. Far outside: in pixels, and as a share of the longer
# side.
_DEEP, _DEEPEST, _DEEP_LATER, _FAR, _FAR_LATER = 2.0, 0.75, 1.5, (4.0, 0.02), (2.5, 0.0125)
# Evidence is smoothed by so much of the longer side, and by so many pixels at least.
_BLUR, _LEAST_BLUR = 0.002, 0.6
# Photographs with more noise than this, in levels of 255, have no say: in the dark parts of what they show is next to
# nothing else, and right masks look wrong. The share of the image that has to be beside the liquid to tell; and the
# median of a normal variable's size, by its standard deviation.
_NOISY, _LEAST_BESIDE, _MEDIAN_OF_NORMAL = 14.0, 0.02, 0.6745
# Outlines as near as this to each other are the same, in pixels of an image of 240.
_SAME = 1.25
# The masks of a camera are replaced where the middle one is wrong by more than the first share of its area, or by more
# than the second where the middle camera's is, but for those that are wrong by less than the third; single masks where
# they are wrong by more than the fourth. Areas count as the last share of the image at least.
_WRONG, _WRONG_TOO, _RIGHT, _ONE_WRONG, _LEAST_AREA = 0.2, 0.1, 0.05, 0.3, 0.0005
# Timesteps that are named, and pixels that are worth a word.
_NAMED, _WORTH_A_WORD = 5, 0.5
# Photographs are asked again, beginning with so many pixels less and more. Of what such a start is apart from the
# masks, so much has to be gone from the answer.
_STARTS, _MET = (-2.0, 2.0), 0.5
# How much outline what they say has to have for its area, by what the masks have.
_AS_SHARP = 0.55


@dataclass(frozen=True)
class PackedMasks:
    """Masks of one camera by timestep, eight pixels a byte."""

    shape: tuple[int, int]
    bits: Mapping[int, bytes]

    @classmethod
    def of(cls, shape: tuple[int, int], masks: Iterable[tuple[int, Masks]]) -> PackedMasks:
        return cls(shape, {t: np.packbits(mask).tobytes() for t, mask in masks})

    @property
    def digest(self) -> str:
        """Tells these masks from others."""
        return hashlib.sha256(b"".join(b"%d:" % t + bits for t, bits in sorted(self.bits.items()))).hexdigest()

    def __contains__(self, t: int) -> bool:
        return t in self.bits

    def __getitem__(self, t: int) -> Masks:
        flat = np.unpackbits(np.frombuffer(self.bits[t], np.uint8), count=self.shape[0] * self.shape[1])
        return flat.reshape(self.shape).astype(bool)


@dataclass(frozen=True)
class Outlines:
    """Of one camera: masks as photographs show them, where the told ones are wrong.

    beyond: how far the told masks reach beyond these, in pixels, in the middle; below 0 they end inside; None where
    there were hardly any.
    """

    masks: PackedMasks
    n_frames: int
    beyond: float | None

    @property
    def line(self) -> str:
        """What is wrong, in words."""
        wrong = sorted(self.masks.bits)
        if self.beyond is None:
            return "masks show next to no liquid; it is taken from what changes in its photographs"
        if len(wrong) < self.n_frames:
            some = ", ".join(map(str, wrong[:_NAMED])) + (" ..." if len(wrong) > _NAMED else "")
            which = f"{len(wrong)} of {self.n_frames} masks are not what its photographs show (timesteps {some})"
        elif abs(self.beyond) < _WORTH_A_WORD:
            which = "masks are not what its photographs show"
        elif self.beyond > 0:
            which = f"masks reach {self.beyond:.1f} px beyond what its photographs show"
        else:
            which = f"masks end {-self.beyond:.1f} px inside what its photographs show"
        return f"{which}; replaced by what these show"


@dataclass(frozen=True)
class Sample:
    """Some frames of one camera, small: images [F, h, w, 3], masks [F, h, w] as told. frames: their timesteps."""

    frames: tuple[int, ...]
    images: Images
    masks: Masks


@dataclass(frozen=True)
class Evidence:
    """Log likelihood ratios of bins, float32 [bins^3]: of differences from the plate, and of colours."""

    difference: NDArray[np.float32]
    color: NDArray[np.float32]

    def of_color(self, image: Images) -> NDArray[np.float32]:
        """How much the colour of each pixel of `image` [H, W, 3] speaks for liquid, in nats."""
        return np.asarray(self.color[_color_bins(image)])

    def each(self, image: Images, plate: Images, free: Masks) -> NDArray[np.float32]:
        """How much each pixel of `image` [H, W, 3] speaks for liquid, in nats: its colour, and where some frame is
        `free` of liquid, so that there is a plate, its difference from this."""
        color = self.of_color(image)
        return np.where(free, self.difference[_difference_bins(image, plate)] + color, color)

    def mask(self, image: Images, plate: Images, free: Masks, told: Masks) -> Masks:
        """What `image` [H, W, 3] says is liquid. Where no frame is `free` of it there is no plate, and
        the colour says so where it is sure, elsewhere the mask that was told."""
        smooth = smoothed(self.each(image, plate, free))
        return np.where(free | (np.abs(smooth) > SURE), smooth > _FROM, told)


@dataclass(frozen=True)
class Answer:
    """What photographs say: masks [F, h, w], and by what they say it; None where they say nothing."""

    masks: Masks
    evidence: Evidence | None

    def plate(self, sample: Sample) -> tuple[Images, Masks]:
        """The clean plate of `sample` by its masks, uint8 [h, w, 3], and where there is one, bool [h, w]."""
        outside = _far_outside(np.stack([outline_distance(mask) for mask in self.masks]), _FAR_LATER)
        return masked_median(sample.images, outside), np.asarray(outside.any(axis=0))


@dataclass(frozen=True)
class Examined:
    """Of some cameras: outlines of those whose masks are not what the photographs show, the names of those whose masks
    seem wrong, while what photographs say instead is not to be trusted, and the noise in levels of those whose
    photographs are too noisy to be asked."""

    outlines: Mapping[str, Outlines]
    untrusted: tuple[str, ...]
    noisy: Mapping[str, float] = field(default_factory=dict)


def examined(scene: TrainingScene, names: Sequence[str]) -> Examined:
    """The masks of the training cameras `names` of `scene`, held against its photographs."""
    every = {name: sampled(scene, name) for name in names}
    noise = {name: noise_of(sample) for name, sample in every.items()}
    noisy = {name: levels for name, levels in noise.items() if levels > _NOISY}
    samples = {name: sample for name, sample in every.items() if name not in noisy}
    if not samples:
        return Examined({}, (), noisy)
    wrong = {}
    for name, sample in samples.items():
        shown = asked(sample, sample.masks, _ROUNDS).masks
        wrong[name] = np.array([_wrong(*pair) for pair in zip(sample.masks, shown)])
    middle = float(np.median([np.median(of_camera) for of_camera in wrong.values()]))
    found: dict[str, Outlines] = {}
    untrusted = []
    for name, sample in samples.items():
        if _suspicious(wrong[name], middle).any():
            answer = asked(sample, sample.masks, _ROUNDS_MORE)
            if answer.evidence is not None and _trusted(sample, answer.masks):
                replaced = _replaced(scene, name, sample, answer, middle)
                found |= {name: replaced} if replaced else {}
            else:
                untrusted.append(name)
    return Examined(found, tuple(untrusted), noisy)


def noise_of(sample: Sample) -> float:
    """The noise of the photographs of `sample` in levels (standard deviation): by how much what changes from one to the
    next differs between neighbours, at most pixels beside the liquid, which changes itself. Light that changes does so
    for both. 0 where there is nothing to tell it by: one image, or liquid nearly everywhere."""
    middles = []
    for t in range(len(sample.images) - 1):
        change = sample.images[t + 1].astype(np.int16) - sample.images[t]
        beside = ~(sample.masks[t + 1] | sample.masks[t])
        differences = np.diff(change, axis=1)[beside[:, 1:] & beside[:, :-1]]
        if len(differences) >= _LEAST_BESIDE * beside.size:
            middles.append(float(np.median(np.abs(differences))))
    return float(np.median(middles)) / (2 * _MEDIAN_OF_NORMAL) if middles else 0.0


def sampled(scene: TrainingScene, name: str) -> Sample:
    """Some frames of camera `name`."""
    camera = scene.cameras[name]
    chosen = spread_frames(scene.n_frames, FRAMES).tolist()
    scale = min(1.0, _SIDE / max(camera.width, camera.height))
    size = (max(1, round(camera.width * scale)), max(1, round(camera.height * scale)))
    images = np.empty((len(chosen), size[1], size[0], 3), np.uint8)
    masks = np.empty(images.shape[:3], bool)

    def read(i: int) -> None:
        # Shrunk one by one: large photographs do not fit into memory together.
        image, mask = scene.image(name, chosen[i]), scene.mask(name, chosen[i])
        images[i] = image if scale == 1.0 else cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        masks[i] = mask if scale == 1.0 else _resized(mask, size)

    each(read, range(len(chosen)))
    return Sample(tuple(chosen), images, masks)


def _resized(mask: Masks, size: tuple[int, int]) -> Masks:
    """`mask` with `size` (columns, rows)."""
    smaller = size[0] < mask.shape[1]
    share = cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA if smaller else cv2.INTER_LINEAR)
    return np.asarray(share >= 0.5)


def asked(sample: Sample, start: Masks, rounds: int, may_fail: bool = True) -> Answer:
    """What the photographs of `sample` say, asked with the masks `start` [F, h, w] in the first round. may_fail: an
    empty one of these may be one that failed."""
    colors = _color_bins(sample.images)
    masks, evidence = start, None
    for number in range(rounds):
        depth = np.stack([outline_distance(mask) for mask in masks])
        outside = _far_outside(depth, _FAR if number == 0 else _FAR_LATER)
        shown = masks.any(axis=(1, 2), keepdims=True)
        if number == 0 and may_fail and shown.mean() > 0.5:
            # What a mask that failed would add to the plate is liquid.
            outside &= shown
        inside = depth > (_deep(depth) if number == 0 else _DEEP_LATER)
        if not inside.any() and masks.any():
            inside = depth >= np.median(depth[masks])
        free: Masks = np.asarray(outside.any(axis=0))
        plate = masked_median(sample.images, outside)
        inside &= free
        if not inside.any() or not outside.any():
            break
        differences = _difference_bins(sample.images, plate)
        evidence = Evidence(
            _likelihood_ratio(differences[inside], differences[outside]),
            _likelihood_ratio(colors[inside], colors[outside]),
        )
        masks = np.stack([evidence.mask(image, plate, free, mask) for image, mask in zip(sample.images, masks)])
    return Answer(masks, evidence)


def _far_outside(depth: NDArray[np.float32], far: tuple[float, float]) -> Masks:
    """The pixels of `depth` [..., h, w] inside outlines that are `far` outside: in pixels, or as a share of the longer
    side where that is more."""
    return np.asarray(depth < -max(far[0], far[1] * max(depth.shape[-2:])))


def _deep(depth: NDArray[np.float32]) -> float:
    """How deep is deep inside, in pixels, in the first round."""
    inside = depth[(depth > 0) & np.isfinite(depth)]
    return max(_DEEP, float(np.quantile(inside, _DEEPEST))) if len(inside) else _DEEP


def _trusted(sample: Sample, answer: Masks) -> bool:
    """Whether photographs say much the same as `answer` when they are asked with less or with more than the masks, and
    show as much of outlines as these."""
    if _outline(answer) < _AS_SHARP * _outline(sample.masks):
        return False
    depth = np.stack([outline_distance(mask) for mask in sample.masks])
    met = []
    for beyond in _STARTS:
        start = depth > -beyond
        before = _in_common(sample.masks, start)
        after = _in_common(answer, asked(sample, start, _ROUNDS_MORE).masks)
        met.append((after - before) / max(1 - before, 1e-6))
    return max(met) >= _MET


def _outline(masks: Masks) -> float:
    """Pixels along the outlines of `masks` [F, h, w], by their area."""
    along = sum(int((np.abs(outline_distance(mask)) < 1).sum()) for mask in masks)
    return along / max(1, int(masks.sum()))


def _in_common(one: Masks, other: Masks) -> float:
    """Intersection over union of all frames together."""
    return float((one & other).sum() / max(1, (one | other).sum()))


def _wrong(told: Masks, said: Masks) -> float:
    """The pixels of `told` [h, w] that are wrong by `said`, by the larger area of both; outlines that are the same but
    for `_SAME` are right."""
    return float(_apart(told, said).sum() / max(told.sum(), said.sum(), _LEAST_AREA * told.size))


def _reach(mask: Masks) -> float:
    """Pixels within which outlines are the same."""
    return _SAME * max(1.0, max(mask.shape) / 240)


def _apart(told: Masks, said: Masks) -> Masks:
    """The pixels [h, w] of which one says that they are liquid, farther from the outline of `told` than `_SAME`."""
    depth, reach = outline_distance(told), _reach(told)
    return np.asarray((said & (depth < -reach)) | (~said & (depth > reach)))


def _mended(told: Masks, said: Masks) -> Masks:
    """`told` with what `said` says where they are apart, and beside that; the rest of its outline stays."""
    radius = int(np.ceil(_reach(told))) + 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    there = cv2.dilate(_apart(told, said).astype(np.uint8), disc).astype(bool)
    return np.where(there, said, told)


def _suspicious(wrong: NDArray[np.float64], middle: float) -> NDArray[np.bool_]:
    """Which masks of a camera are to be replaced, bool [F], by how wrong each is, and the middle one of the middle
    camera."""
    own = float(np.median(wrong))
    if own > _WRONG or min(own, middle) > _WRONG_TOO:
        return np.asarray(wrong > _RIGHT)
    return np.asarray(wrong > _ONE_WRONG)


def said(scene: TrainingScene, name: str, sample: Sample, answer: Answer) -> Iterator[Masks]:
    """The masks of camera `name` in full size and of all timesteps, by the evidence of some small frames."""
    assert answer.evidence is not None
    camera = scene.cameras[name]
    size = (camera.width, camera.height)
    same_size = sample.masks.shape[1:] == (camera.height, camera.width)
    known = answer.masks if same_size else np.stack([_resized(mask, size) for mask in answer.masks])
    outside = np.stack([_far_outside(outline_distance(mask), _FAR_LATER) for mask in known])
    free: Masks = np.asarray(outside.any(axis=0))
    images = sample.images if same_size else np.stack([scene.image(name, t) for t in sample.frames])
    plate = masked_median(images, outside)
    del images, outside
    for t in range(scene.n_frames):
        yield answer.evidence.mask(scene.image(name, t), plate, free, scene.mask(name, t))


def _replaced(scene: TrainingScene, name: str, sample: Sample, answer: Answer, middle: float) -> Outlines | None:
    """The masks of camera `name` that are wrong, as photographs show them; None where none is."""
    right: dict[int, Masks] = {}
    wrong, gained, length = np.empty(scene.n_frames), np.empty(scene.n_frames), np.empty(scene.n_frames)
    for t, mask in enumerate(said(scene, name, sample, answer)):
        told, right[t] = scene.mask(name, t), mask
        wrong[t] = _wrong(told, right[t])
        gained[t] = float(told.sum()) - float(right[t].sum())
        length[t] = max(1.0, (np.abs(outline_distance(right[t])) < 1).sum() / 2)
        if wrong[t] <= _WRONG and abs(gained[t] / length[t]) < _reach(told):
            # The outline of a mask with holes is better than that of photographs which hardly show the liquid.
            right[t] = _mended(told, right[t])
    chosen = np.nonzero(_suspicious(wrong, middle))[0].tolist()
    if not chosen:
        return None
    beyond = float(np.median(gained[chosen] / length[chosen]))
    return Outlines(PackedMasks.of(told.shape, ((t, right[t]) for t in chosen)), scene.n_frames, beyond)


def smoothed(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """`values` [H, W, ...] of pixels, so that the noise of single ones has no say."""
    return np.asarray(cv2.GaussianBlur(values, (0, 0), max(_LEAST_BLUR, _BLUR * max(values.shape[:2]))), np.float32)


@cache
def _bins_of_differences() -> NDArray[np.uint16]:
    """The bin of a difference of -255 to 255, in this order; finer where it is small."""
    share = np.arange(-255, 256) / 255
    return np.minimum((0.5 + 0.5 * np.sign(share) * np.sqrt(np.abs(share))) * _BINS, _BINS - 1).astype(np.uint16)


def _color_bins(images: Images) -> NDArray[np.uint16]:
    """Of uint8 [..., 3] the number of the bin, [...]."""
    parts = images // np.uint8(256 // _BINS)
    return _numbered(parts.astype(np.uint16))


def _difference_bins(images: Images, plate: Images) -> NDArray[np.uint16]:
    """Of uint8 [..., H, W, 3] less `plate` the number of the bin, [..., H, W]."""
    return _numbered(_bins_of_differences()[images.astype(np.int16) - plate + 255])


def _numbered(parts: NDArray[np.uint16]) -> NDArray[np.uint16]:
    return np.asarray((parts[..., 0] * _BINS + parts[..., 1]) * _BINS + parts[..., 2])


def _likelihood_ratio(inside: NDArray[np.uint16], outside: NDArray[np.uint16]) -> NDArray[np.float32]:
    """log(p(bin | inside) / p(bin | outside)) of every bin, float32."""
    ratio = np.log(_density(inside)) - np.log(_density(outside))
    return np.clip(ratio, -_MOST, _MOST).astype(np.float32)


def _density(bins: NDArray[np.uint16]) -> NDArray[np.float64]:
    counts = np.bincount(bins, minlength=_BINS**3).astype(np.float64).reshape(_BINS, _BINS, _BINS)
    smooth = gaussian_filter(counts, _SMOOTHED) + _BESIDE
    return np.asarray((smooth / smooth.sum()).ravel())
