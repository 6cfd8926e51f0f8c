"""Frames that show nothing new: a camera that is slower than the recording, or dropped frames filled with the last one.

Nothing is modelled for them: carriers stay, and no photograph of theirs is fitted to.
"""

from __future__ import annotations

import numpy as np

from splashbench.observe import Silhouettes
from splashbench.scene.scene import TrainingScene

# Levels of 255 by which photographs of the same instant may differ in the mean, for compression.
_SAME_LEVELS = 0.5


def repeated_frames(scene: TrainingScene, silhouettes: Silhouettes) -> np.ndarray:
    """bool [T]: frames in which every training view shows what it showed in the frame before.

    silhouettes: of `scene`. None where cameras have clocks of their own that masks are carved between.
    """
    repeated = np.zeros(scene.n_frames, dtype=bool)
    if silhouettes.between_frames:
        return repeated
    for t in range(1, scene.n_frames):
        repeated[t] = all(
            np.array_equal(silhouettes.mask(view, t), silhouettes.mask(view, t - 1))
            for view in range(len(silhouettes.views))
        ) and all(_same(scene, name, t) for name in silhouettes.views)
    return repeated


def _same(scene: TrainingScene, name: str, t: int) -> bool:
    """Whether the liquid looks as it did. What lies around it stands still anyway, and would hide that it does not."""
    mask = scene.mask(name, t)
    if not mask.any():
        return True
    now, before = scene.image(name, t)[mask], scene.image(name, t - 1)[mask]
    return float(np.abs(now.astype(np.int16) - before).mean()) <= _SAME_LEVELS
