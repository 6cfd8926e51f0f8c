"""The training views' liquid masks, ready for carving: cropped, packed, and turned into 2-D signed distances.

A view whose mask is empty while other views see liquid is a failed mask, not evidence of absence. So is one that the
caller has found wanting (failures.py). Either is replaced by what the view saw just before and after, with what is
left of the mask, or over the whole sequence where those failed too. (Letting k of n views dissent everywhere instead
was measured to cost .1 mIoU.) The paper replaces none: liquid is where the masks of all views have it.

Where an image cuts liquid off, what is past that side is not seen, which is no evidence of absence either (cut_off.py).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np

from splashbench.errors import SplashbenchError
from splashbench.observe.cut_off import CutOff
from splashbench.observe.image_window import ImageWindow
from splashbench.observe.mask_distance import blended, signed_distance_2d
from splashbench.scene.camera import Camera

MARGIN_PIXELS = 8
MIN_WITNESSES = 2
#: signed distance, in pixels, of a view that says nothing
NO_EVIDENCE = -1e6
# A camera that exposes at another time than the scene's, by more than this share of a step, is interpolated.
_SAME_TIME = 0.01
# Of a camera that starts later or stops earlier than the scene by more steps than this, no mask stands for such times.
_TOO_FAR = 0.5
# Frames within which others stand in for a failed mask; farther off the liquid has moved on.
_NEIGHBOURS = 2


class MaskedScene(Protocol):
    """What carving needs of a scene; `Scene` and `TrainingScene` both have it."""

    @property
    def name(self) -> str: ...
    @property
    def cameras(self) -> dict[str, Camera]: ...
    @property
    def train(self) -> tuple[str, ...]: ...
    @property
    def n_frames(self) -> int: ...
    def mask(self, camera: str, t: int) -> np.ndarray: ...


class Silhouettes:
    """Liquid masks of all frames of some views, as packed bits of the windows that hold all the liquid of a view.

    Attributes:
        views, cameras, n_frames: names and cameras of the views that carve; frames of the scene.
        windows: of each view, the part of its images that the masks are kept of; beyond it no liquid is seen.
        cut_off: of each view, what lies past its images where they cut liquid off; None where they do not.
        sees_liquid: bool [T, V], whether a mask shows any liquid.
        failed_masks: bool [T, V], masks that are no evidence of absence; see `distrust`.
    """

    def __init__(
        self,
        scene: MaskedScene,
        views: Sequence[str] | None = None,
        interpolate_times: bool | None = None,
        replace_empty: bool = True,
    ) -> None:
        """Read the masks of `views` (all training views by default), each once.

        interpolate_times: whether a camera that exposes at times of its own (`camera_times` of the scene) is carved
        with at the scene's `times`, between its frames; by default where they differ by over 1% of a step.
        replace_empty: whether an empty mask counts as failed where other views see liquid, or else says that there is
        none.
        Raises SplashbenchError when fewer than two views show liquid in any frame, and when a view shows none at all
        whose empty masks are not replaced.
        """
        self.views = tuple(scene.train if views is None else views)
        self.cameras = [scene.cameras[view] for view in self.views]
        self.n_frames = scene.n_frames
        self.windows: list[ImageWindow] = []
        self.cut_off: list[CutOff | None] = []
        self._packed: list[list[np.ndarray]] = []
        self.sees_liquid = np.zeros((scene.n_frames, len(self.views)), dtype=bool)
        full = True
        for number, view in enumerate(self.views):
            packed, window, cut_off, self.sees_liquid[:, number], all_full = _read(scene, view)
            full &= all_full
            self._packed.append(packed)
            self.windows.append(window)
            self.cut_off.append(cut_off)
        if np.any(self.sees_liquid, axis=0).sum() < MIN_WITNESSES:
            raise SplashbenchError(
                f"{scene.name}: fewer than {MIN_WITNESSES} training views have any liquid in their masks; "
                "check the folder seg/ of the scene"
            )
        if full:
            raise SplashbenchError(
                f"{scene.name}: every liquid mask of the training views is full, which tells nothing about where the "
                "liquid is; check the folder seg/ of the scene"
            )
        # An empty mask between two that show liquid is a failed one of a view that would see some.
        witnesses = self.sees_liquid | (_bridged(self.sees_liquid) & replace_empty)
        self._enough = self.sees_liquid.any(axis=1) & (witnesses.sum(axis=1) >= MIN_WITNESSES)
        self.failed_masks = ~self.sees_liquid & self._enough[:, None] & replace_empty
        dry = [view for number, view in enumerate(self.views) if not self.sees_liquid[:, number].any()]
        if dry and not replace_empty:
            raise SplashbenchError(
                f"{scene.name}: the masks of camera {', '.join(dry)} show no liquid in any frame, and empty masks are "
                "not replaced, so that there is none anywhere; set replace_empty_masks=true, or leave the camera out"
            )
        self._between = [_between(scene, view, interpolate_times) for view in self.views]
        self._absent = np.stack([_absent(scene, view, interpolate_times) for view in self.views], axis=1)
        # Where hardly any camera was there, the nearest masks have to do.
        self._absent &= (~self._absent).sum(axis=1, keepdims=True) > MIN_WITNESSES

    def distrust(self, masks: np.ndarray) -> None:
        """Count `masks` (bool [T, V]) as failed too, in frames that have a hull."""
        self.failed_masks |= masks & self._enough[:, None]

    @property
    def all_there(self) -> bool:
        """Whether every view took photographs at about the time of every frame."""
        return not self._absent.any()

    @property
    def that_see_liquid(self) -> list[tuple[Camera, CutOff | None]]:
        """The cameras whose masks show any liquid, and what their images cut off."""
        return [(self.cameras[view], self.cut_off[view]) for view in np.flatnonzero(self.sees_liquid.any(axis=0))]

    @property
    def between_frames(self) -> bool:
        """Whether some view is carved with between its own frames."""
        return any(share != 0 or first != t for view in self._between for t, (first, _, share) in enumerate(view))

    @property
    def nbytes(self) -> int:
        """Bytes that the masks take."""
        return sum(bits.nbytes for packed in self._packed for bits in packed)

    def mask(self, view: int, t: int) -> np.ndarray:
        """The mask of view number `view` in frame `t` as the scene has it, bool, of its window."""
        height, width = self.windows[view].shape
        return np.unpackbits(self._packed[view][t], count=height * width).reshape(height, width).view(bool)

    def sequence_mask(self, view: int) -> np.ndarray:
        """Everything that view number `view` ever sees as liquid, bool, of its window."""
        ever = np.bitwise_or.reduce(self._packed[view], axis=0)
        height, width = self.windows[view].shape
        return np.unpackbits(ever, count=height * width).reshape(height, width).view(bool)

    def has_liquid(self, t: int) -> bool:
        """Whether enough views see liquid in frame `t` for a hull."""
        return bool(self._enough[t])

    def trusted(self, view: int, t: int) -> bool:
        """Whether view number `view` was there in frame `t`, and no mask that it is carved with then has failed."""
        if self._absent[t, view]:
            return False
        first, second, share = self._between[view][t]
        return not (self.failed_masks[first, view] or (share > 0 and self.failed_masks[second, view]))

    def failed(self, t: int) -> list[str]:
        """Views whose mask of frame `t` is replaced: empty although other views see liquid, or distrusted."""
        return [view for view, failed in zip(self.views, self.failed_masks[t]) if failed]

    def evidence_mask(self, view: int, t: int) -> np.ndarray:
        """Where liquid may be by view number `view` in frame `t`, bool, of its window; a failed mask is replaced."""
        if not self.failed_masks[t, view]:
            return self.mask(view, t)
        near = self._neighbours(view, t)
        if not near:
            return self.sequence_mask(view)
        return np.logical_or.reduce([self.mask(view, frame) for frame in (t, *near)])

    def certain_mask(self, view: int, t: int) -> np.ndarray:
        """Where view number `view` is sure of liquid in frame `t`, bool, of its window.

        To a failed mask comes what the frames beside it agree on.
        """
        mask = self.mask(view, t)
        if self.failed_masks[t, view] and (near := self._neighbours(view, t)):
            mask |= np.logical_and.reduce([self.mask(view, frame) for frame in near])
        return mask

    def _neighbours(self, view: int, t: int) -> list[int]:
        """The nearest frame before and after `t` whose mask is trusted; none where one of them is far."""
        trusted = np.nonzero(self.sees_liquid[:, view] & ~self.failed_masks[:, view])[0]
        near = [*trusted[trusted < t][-1:].tolist(), *trusted[trusted > t][:1].tolist()]
        return near if len(near) == 2 and near[1] - t <= _NEIGHBOURS and t - near[0] <= _NEIGHBOURS else []

    def distance(self, view: int, t: int, window: ImageWindow | None = None) -> np.ndarray:
        """2-D signed distance of view number `view` at the time of frame `t`, float32, of `window`.

        window: one that holds the view's own, which is the default; liquid may be past the image in it.
        """
        if self._absent[t, view]:
            return self._no_evidence(view, window)
        first, second, share = self._between[view][t]
        distance = self._frame_distance(view, first, window)
        if share == 0:
            return distance
        return blended(distance, self._frame_distance(view, second, window), share)

    def inside(self, view: int, t: int) -> np.ndarray:
        """Where `distance` of the view's window is below 0, bool; without computing it where no masks are blended."""
        if self._absent[t, view]:
            return np.ones(self.windows[view].shape, dtype=bool)
        first, _, share = self._between[view][t]
        return self.evidence_mask(view, first) if share == 0 else self.distance(view, t) < 0

    def sequence_distance(self, view: int, window: ImageWindow | None = None) -> np.ndarray:
        """2-D signed distance to everything that view number `view` ever sees as liquid, of `window`."""
        return self._distance(view, self.sequence_mask(view), window, 0, self.n_frames - 1)

    def certain_distance(self, view: int, t: int, window: ImageWindow | None = None) -> np.ndarray:
        """2-D signed distance to `certain_mask`, of `window`."""
        return self._distance(view, self.certain_mask(view, t), window, t, t)

    def _no_evidence(self, view: int, window: ImageWindow | None) -> np.ndarray:
        return np.full((window or self.windows[view]).shape, NO_EVIDENCE, dtype=np.float32)

    def _frame_distance(self, view: int, t: int, window: ImageWindow | None) -> np.ndarray:
        anywhere = self.failed_masks[t, view] and not self._neighbours(view, t)
        first, last = (0, self.n_frames - 1) if anywhere else (t, t)
        return self._distance(view, self.evidence_mask(view, t), window, first, last)

    def _distance(self, view: int, mask: np.ndarray, window: ImageWindow | None, first: int, last: int) -> np.ndarray:
        """first, last: the frames that `mask` is of."""
        mask_window = self.windows[view]
        if window is not None and window != mask_window:
            mask = np.pad(mask, mask_window.margins(window))
            if (cut_off := self.cut_off[view]) is not None and not cut_off.image.holds(window):
                mask |= cut_off.liquid(first, last, window)
        if not mask.any() and not self.sees_liquid[:, view].any():
            # A camera without a single usable mask votes for nothing and against nothing.
            return self._no_evidence(view, window)
        return signed_distance_2d(mask)


def _read(scene: MaskedScene, view: str) -> tuple[list[np.ndarray], ImageWindow, CutOff | None, np.ndarray, bool]:
    """Masks of a view as packed bits of their common window; that window, what is past the images, which show liquid
    [T], whether all are full.

    Packed one by one, as all masks at once would be eight times as large.
    """
    ever: np.ndarray | None = None
    masks, borders = [], []
    full = True
    for t in range(scene.n_frames):
        mask = scene.mask(view, t)
        ever = mask.copy() if ever is None else np.logical_or(ever, mask, out=ever)
        full &= bool(mask.all())
        borders.append((mask[:, 0].copy(), mask[:, -1].copy(), mask[0].copy(), mask[-1].copy()))
        masks.append(np.packbits(mask))
    assert ever is not None
    window = ImageWindow.around(ever, MARGIN_PIXELS)
    sees = np.array([bits.any() for bits in masks])
    for t, bits in enumerate(masks):
        mask = np.unpackbits(bits, count=ever.size).reshape(ever.shape)[window.slices]
        masks[t] = np.packbits(mask)
    left, right, top, bottom = (np.stack(border) for border in zip(*borders))
    return masks, window, CutOff.of((left, right, top, bottom), window), sees, full


def _absent(scene: MaskedScene, view: str, interpolate: bool | None) -> np.ndarray:
    """Frames whose time is more than `_TOO_FAR` steps before the first one of `view` or after its last: bool [T]."""
    times, exposed = getattr(scene, "times", None), getattr(scene, "camera_times", {}).get(view)
    if interpolate is False or times is None or exposed is None or scene.n_frames < 2:
        return np.zeros(scene.n_frames, dtype=bool)
    far = _TOO_FAR * float(np.diff(times).mean())
    return np.asarray((times < exposed[0] - far) | (times > exposed[-1] + far))


def _bridged(sees: np.ndarray) -> np.ndarray:
    """Of bool [T, V]: the frames in which a view has one in which it sees liquid shortly before, and one after."""
    before, after = np.zeros_like(sees), np.zeros_like(sees)
    for off in range(1, _NEIGHBOURS + 1):
        before[off:] |= sees[:-off]
        after[:-off] |= sees[off:]
    return before & after


def _between(scene: MaskedScene, view: str, interpolate: bool | None) -> list[tuple[int, int, float]]:
    """For each frame, the two frames of `view` about the scene's time, and the share of the second."""
    alone = [(t, t, 0.0) for t in range(scene.n_frames)]
    # Optional, as a scene may have no more than masks and cameras.
    times, exposed = getattr(scene, "times", None), getattr(scene, "camera_times", {}).get(view)
    if interpolate is False or times is None or exposed is None or scene.n_frames < 2:
        return alone
    step = float(np.diff(times).mean())
    if interpolate is None and np.abs(exposed - times).max() <= _SAME_TIME * step:
        return alone
    for t, time in enumerate(times):
        before = int(np.clip(np.searchsorted(exposed, time, side="right") - 1, 0, scene.n_frames - 2))
        share = float(np.clip((time - exposed[before]) / (exposed[before + 1] - exposed[before]), 0.0, 1.0))
        alone[t] = (before, before + 1, share) if share < 1 else (before + 1, before + 1, 0.0)
    return alone
