"""Where liquid is where hardly any mask says so: it is what changes in the photographs.

A pixel that differs from the photograph that the recording begins with, or from the median one, may be liquid. Both
are asked as masks are (outlines.py). Of the answers the one is taken that is most sure of what is beside the liquid:
where the first photograph shows liquid already, or the median one does, the place that it leaves is in doubt. There
the colours that were learned tell, and all is asked once more.

A shadow darkens what it falls on and leaves its hue, so that it is told from liquid where it does not fall on liquid.
What else moves is taken for liquid: a hand, or what the container mirrors. That is why masks that there are go before.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from splashbench.observe.mask_distance import outline_distance
from splashbench.scene.frames import spread_frames
from splashbench.scene.scene import TrainingScene

from .outlines import (
    FRAMES,
    SURE,
    Answer,
    Masks,
    Outlines,
    PackedMasks,
    Sample,
    asked,
    said,
    sampled,
    smoothed,
)

# Masks of less than this share of the image, in the mean, show next to nothing. What changes is no liquid where it is
# less than that, or more than the other.
_HARDLY, _MOST = 0.0005, 0.4
# What there is of masks has to be within what is found by this share, and so much smaller.
_WITHIN, _SMALLER = 0.8, 4.0
# A change is so many levels of 255 at least, and so many times the usual difference.
_LEVELS, _TIMES = 10.0, 6.0
# A shadow leaves this share of the light at least.
_DARKEST = 0.4
# By so many nats the answer by the median photograph has to be surer than the other: where liquid stands all the time
# its edges alone change, and the median says that they are all.
_SURER = 1.0
# Rounds of questions, and of those after colours had a say. How far beside the liquid answers are compared, as a share
# of the longer side.
_ROUNDS, _ROUNDS_MORE, _BESIDE = 8, 5, 0.05


def hardly_masked(scene: TrainingScene) -> bool:
    """Whether the masks of at least half of the training cameras of `scene` show next to no liquid. Where they are
    fewer, the others tell where it is."""
    frames = spread_frames(scene.n_frames, FRAMES)
    hardly = [np.mean([scene.mask(name, int(t)).mean() for t in frames]) < _HARDLY for name in scene.train]
    return bool(2 * sum(hardly) >= len(hardly))


def unconfirmed(scene: TrainingScene) -> list[str]:
    """The training cameras of `scene` without any mask, or whose photographs show much more than their masks when they
    are asked with these: little liquid may be all there is."""
    samples = {name: sampled(scene, name) for name in scene.train}
    return [
        name
        for name, sample in samples.items()
        if asked(sample, sample.masks, _ROUNDS).masks.sum() >= _SMALLER * sample.masks.sum()
    ]


def outlines_by_change(scene: TrainingScene, names: Sequence[str]) -> dict[str, Outlines]:
    """Masks as photographs show them, of the training cameras of `names` whose own show next to nothing of it; without
    those whose photographs show no liquid either."""
    found = {}
    for name in names:
        sample = sampled(scene, name)
        answer = _surest(sample)
        if answer is not None and _plausible(sample.masks, answer.masks):
            masks = PackedMasks.of(scene.mask(name, 0).shape, enumerate(said(scene, name, sample, answer)))
            found[name] = Outlines(masks, scene.n_frames, None)
    return found


def _surest(sample: Sample) -> Answer | None:
    """The answer that is most sure of what is beside the liquid; None where photographs say nothing."""
    first, median = sample.images[0], np.median(sample.images, axis=0)
    told = []
    for plate, handicap in ((first, 0.0), (median, _SURER)):
        start = _changed(sample, plate)
        answer = asked(sample, start, _ROUNDS, may_fail=False)
        if answer.evidence is not None and answer.masks.any():
            told.append((_doubt(sample, answer) + handicap, answer, start))
    if not told:
        return None
    _, found, start = min(told, key=lambda each: each[0])
    again = asked(sample, _by_color(sample, found, start), _ROUNDS_MORE, may_fail=False)
    if again.evidence is None or not again.masks.any():
        return found
    return min(again, found, key=lambda answer: _doubt(sample, answer))


def _by_color(sample: Sample, found: Answer, changed: Masks) -> Masks:
    """`found`, with what colours say where they are sure and pixels ever `changed`: liquid that was there in the
    photograph that others were compared with is not seen by the change, but its leaving is."""
    assert found.evidence is not None
    ever = changed.any(axis=0)
    color = np.stack([smoothed(found.evidence.of_color(image)) for image in sample.images])
    return np.where(ever & (np.abs(color) > SURE), color > 0, found.masks)


def _changed(sample: Sample, plate: NDArray[np.generic]) -> Masks:
    """Where the photographs of `sample` differ from `plate` [h, w, 3] by more than a shadow, bool [F, h, w]."""
    behind = plate.astype(np.float32)
    difference = np.stack([smoothed(np.abs(image - behind).max(axis=2)) for image in sample.images])
    least = max(_LEVELS, _TIMES * float(np.median(difference)))
    shadows = np.stack([_shadow(smoothed(image.astype(np.float32)), behind, least) for image in sample.images])
    return np.asarray((difference > least) & ~shadows)


def _shadow(image: NDArray[np.float32], plate: NDArray[np.float32], least: float) -> Masks:
    """Where `image` [h, w, 3] is the plate, but darker, or lighter since a shadow left: of its hue to less than `least`
    levels."""
    share = (image * plate).sum(axis=2) / np.maximum((plate * plate).sum(axis=2), 1)
    hue = np.abs(image - share[..., None] * plate).max(axis=2)
    return np.asarray((share > _DARKEST) & (share < 1 / _DARKEST) & (hue < least))


def _doubt(sample: Sample, answer: Answer) -> float:
    """What speaks for liquid just beside what `answer` takes for it, in nats, in the mean."""
    assert answer.evidence is not None
    reach = _BESIDE * max(answer.masks.shape[1:])
    depth = np.stack([outline_distance(mask) for mask in answer.masks])
    plate, free = answer.plate(sample)
    speaks = np.stack([answer.evidence.each(image, plate, free) for image in sample.images])
    beside = (depth < 0) & (depth > -reach)
    return float(speaks[beside].mean()) if beside.any() else 0.0


def _plausible(told: Masks, found: Masks) -> bool:
    """Whether what was `found` is as much as a liquid may be, and holds what there is of masks."""
    if not _HARDLY <= found.mean() <= _MOST or found.sum() < _SMALLER * told.sum():
        return False
    return bool((told & found).sum() >= _WITHIN * told.sum())
