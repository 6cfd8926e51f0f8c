"""What the fit of the appearance begins with: photographs, and what is known of each carrier's looks before it.

That is what photographs show of it (appearance/first_look.py) or what coarse grids taught (appearance/warm_start.py).
Carriers that these taught to be transparent are left out here, before anything is made for them: they are a third of
all on a splash, and the fit has several arrays as long as there are carriers.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch

from splashbench.gaussians.devices import CPU
from splashbench.native import memory
from splashbench.render import Frozen
from splashbench.scene.scene import TrainingScene

from .appearance.coarse import HALVINGS, set_smaller_backgrounds, with_smaller
from .appearance.first_look import FirstLook, Look, photographed, take_on
from .appearance.fit_settings import FitSettings
from .appearance.fitting import Appearance, initial_appearance, visible_carriers
from .appearance.glass import glass_before
from .appearance.targets import TrainingTarget, collect_targets, set_backgrounds
from .appearance.warm_start import Learned, hand_on
from .fields.occlusion import LiquidOcclusion
from .trace import Traced

# Pixels along the longer side of the images for which the setting `glass` is meant.
_GLASS_SIDE = 240


@dataclass(frozen=True)
class Beginning:
    """targets: the photographs whose masks did not fail; there may be none. look: how they show the carriers, None
    where it was not asked for. settings: of the fit, with what was made of it elsewhere."""

    appearance: Appearance
    targets: list[TrainingTarget]
    look: Look | None
    settings: FitSettings


def begin(
    scene: TrainingScene,
    backgrounds: dict[str, np.ndarray],
    traced: Traced,
    occlusion: LiquidOcclusion | None,
    frozen: Mapping[str, Frozen] | None,
    seed: int,
    device: str,
    learned: list[Learned] | None,
    handed_on: bool,
) -> Beginning:
    """What the appearance of the carriers of `traced` begins with.

    backgrounds, frozen: see `fit_liquid`. learned: on coarser grids, to begin with; taken out of the list, as it is
    large. The carriers that it shows to be transparent are taken out of `traced`. handed_on: whether another fit begins
    with what this one learns.
    """
    config, observations = traced.config, traced.observations
    # Gaussians of the background that are drawn together with the liquid's are prepared for one size.
    longest = max(max(camera.width, camera.height) for camera in scene.cameras.values())
    coarse = frozen is None and config.coarse_share > 0 and longest > config.coarse_side
    memory.give_back()
    targets = collect_targets(
        scene,
        backgrounds,
        traced.track,
        config.silhouette_norm,
        camera_times=config.camera_times,
        trusted=~(observations.silhouettes.failed_masks | observations.repeated[:, None]),
        hidden=None if occlusion is None else lambda name, points: occlusion.hidden(scene.cameras[name], points),
        cut=None if occlusion is None else lambda name, points: occlusion.cut(scene.cameras[name], points),
        frozen=frozen,
        blocks=2**HALVINGS if coarse else 1,
    )
    if coarse:
        nowhere = np.zeros((0, 3))
        cuts = {
            name: None if occlusion is None else occlusion.cut(scene.cameras[name], nowhere) for name in scene.train
        }
        # To read large photographs once more for it would take longer than to look at them.
        first = FirstLook(traced.track) if targets and config.first_look else None
        walls = {name: None if cut is None else cut[0] for name, cut in cuts.items()}
        with_smaller(targets, backgrounds, walls, first)
        look = None if first is None else first.look()
    else:
        look = photographed(traced.track, targets) if targets and config.first_look else None
    memory.give_back()
    if occlusion is not None:
        occlusion.forget()
    memory.give_back()
    count, voxel = traced.track.carriers.count, observations.grid.voxel
    appearance = initial_appearance(count, voxel, config.optimisation, config.decoder, seed)
    if observations.in_transparent_container and frozen is None:
        # Edges have so many more pixels along them.
        appearance.glass = glass_before(traced.track, round(config.glass * longest / _GLASS_SIDE), seed)
    settings = replace(config.optimisation, handed_on=handed_on and config.price > 0)
    if not targets:
        return Beginning(appearance, targets, None, settings)
    if learned:
        hand_on(learned.pop(), traced.track, look, appearance, config.base_scale)
        # Of the iterations on these grids, the first ones have stand-ins for the background.
        plates_share = 1 - (1 - config.coarse_grids_share) * (1 - config.plates_share)
        settings = replace(settings, begun=config.coarse_iterations, plates_share=plates_share)
        look = None  # large, and nobody goes on from here
        _leave_out(visible_carriers(appearance, config.prune_opacity), traced, appearance, targets)
    elif look is not None:
        take_on(look, appearance.features, appearance.decoder)
    if device != CPU:
        set_backgrounds(targets, backgrounds.items(), device)
        set_smaller_backgrounds(targets, backgrounds.items(), device)
    memory.give_back()
    return Beginning(appearance, targets, look, settings)


def _leave_out(kept: np.ndarray, traced: Traced, appearance: Appearance, targets: list[TrainingTarget]) -> None:
    """Go on with the carriers `kept` (bool [count]) alone, in place."""
    carriers = traced.track.carriers
    for target in targets:
        of_frame = torch.from_numpy(kept[carriers.ids[carriers.rows(target.frame)]])
        sizes: TrainingTarget | None = target
        while sizes is not None:
            sizes.hidden = None if sizes.hidden is None else sizes.hidden[of_frame]
            sizes.in_front = None if sizes.in_front is None else sizes.in_front[of_frame]
            sizes = sizes.coarse
    del carriers
    rows = torch.from_numpy(traced.keep(kept))
    appearance.features = appearance.features.index_select(0, rows)
    appearance.log_scales = appearance.log_scales.index_select(0, rows)
