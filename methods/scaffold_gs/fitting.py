"""Fits the anchors to the plates by gradient descent, then drops what no plate vouches for.

Loss .8 L1 + .2 (1 - SSIM) + .01 mean(prod scale) over seen pixels, as in Scaffold-GS; scales are in scene units there,
which `volume_unit` can replace by the anchors' spacing. Where the settings ask for it,
the first steps see smaller images (a step's cost is mostly that of its pixels), and anchors grow (growth.py).
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray

from splashbench.background.clean_plate import CleanPlate, shrunk
from splashbench.errors import SplashbenchError
from splashbench.gaussians.anchor_seeds import AnchorSeed
from splashbench.gaussians.color_loss import l1
from splashbench.gaussians.ssim import SsimTarget, ssim
from splashbench.render import rasterize

from .growth import Growth
from .model import PER_ANCHOR, AnchorModel, StaticAnchorSpec
from .optimizer import AnchorOptimizer
from .settings import BackgroundSettings

_SSIM_WEIGHT = 0.2
_VOLUME_WEIGHT = 0.01
# Of the iterations left, each coarser level of the pyramid takes this share.
_COARSE_SHARE = 0.5
# The structural term's targets, a plate's as float32 each, are kept between steps up to this size.
_TARGET_BYTES = 85 << 20
# An anchor stays if it makes up at least this much of the seen pixels of all training views together.
_MIN_PIXELS = 0.5


class _Views:
    """The plates at one size, in random order, each once before any comes again."""

    def __init__(self, plates: list[CleanPlate], longest_side: int, rng: np.random.Generator) -> None:
        self.plates = [shrunk(plate, longest_side) for plate in plates]
        self._rng, self._order = rng, list[int]()
        self._kept: dict[int, SsimTarget] = {}
        self._keep = sum(plate.image.size for plate in self.plates) * 4 <= _TARGET_BYTES

    def next(self) -> int:
        if not self._order:
            self._order = self._rng.permutation(len(self.plates)).tolist()
        return self._order.pop()

    def structure(self, view: int) -> SsimTarget:
        target = self._kept.get(view)
        if target is None:
            plate = self.plates[view]
            target = SsimTarget(plate.floats(), plate.seen.astype(np.float32))
            if self._keep:
                self._kept[view] = target
        return target


def pyramid(longest_side: int, coarse_side: int, iterations: int) -> dict[int, int]:
    """Iteration at which images of a size (longest side, pixels) are first used, from coarse to fine."""
    sizes = [longest_side]
    while sizes[0] > coarse_side:
        sizes.insert(0, (sizes[0] + 1) // 2)
    starts: dict[int, int] = {}
    start = 0.0
    for size in sizes:
        starts.setdefault(round(start), size)
        start += (iterations - start) * _COARSE_SHARE
    return starts


def fit_model(
    seed: AnchorSeed,
    plates: list[CleanPlate],
    settings: BackgroundSettings,
    far_color: NDArray[np.float32],
    random_seed: int,
    progress: Callable[[float], None],
    after_step: Callable[[AnchorModel], None] = lambda model: None,
    device: str = "cpu",
) -> AnchorModel:
    """Optimise a model that starts at `seed`; `progress` hears the fraction done. `plates` show something each.

    after_step: hears the model as it is after every step. device: where the model is fitted, and returned.

    Raises SplashbenchError where the loss stops being finite.
    """
    rng = np.random.default_rng(random_seed)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(random_seed)
        variant = StaticAnchorSpec(settings.children, settings.view_dependent_shape, settings.base_color)
        model = AnchorModel.from_seed(seed, variant, settings.spread_start).to(device)
        optimizer = AnchorOptimizer(model, settings.rates, settings.iterations, settings.rates_until)
        growth = Growth(optimizer, seed.voxel, settings, rng)
        shares = (settings.count_from, settings.grow_from, settings.grow_until)
        count_from, grow_from, grow_until = (round(share * settings.iterations) for share in shares)
        unit = float(np.median(seed.spacing)) if settings.volume_unit == "spacing" else 1.0
        behind = torch.as_tensor(far_color).to(device)
        longest = max(max(plate.camera.width, plate.camera.height) for plate in plates)
        sizes = pyramid(longest, settings.coarse_side, settings.iterations)
        for iteration in range(settings.iterations):
            if iteration in sizes:
                views = _Views(plates, sizes[iteration], rng)
            view = views.next()
            plate = views.plates[view]
            counting = min(count_from, grow_from) <= iteration < grow_until
            # Growth counts visits of all anchors.
            gaussians = model.decode(plate.camera.center, None if counting else model.in_view(plate.camera))
            means, factors, opacities, colors, scales = gaussians
            image, _ = rasterize(means, factors, opacities, colors, plate.camera, background=behind)
            loss = (1 - _SSIM_WEIGHT) * l1(image, plate.image, plate.seen)
            if iteration % settings.ssim_every == 0:
                loss = loss + settings.ssim_every * _SSIM_WEIGHT * (1 - ssim(image, views.structure(view)))
            drawn = opacities.detach() > 0
            volumes = (scales / unit).prod(dim=1) * drawn
            loss = loss + _VOLUME_WEIGHT * volumes.sum() / drawn.sum().clamp(min=1)
            if not math.isfinite(float(loss.detach())):
                raise SplashbenchError(
                    f"the background's loss is {float(loss.detach())} at iteration {iteration + 1}; see that the "
                    "scene's images and cameras are right, or give another seed"
                )
            if counting:
                means.retain_grad()
            loss.backward()
            optimizer.step()
            if counting:
                growth.observe(plate.camera, gaussians)
                if iteration >= grow_from and (iteration + 1 - grow_from) % settings.grow_every == 0:
                    growth.round()
            if iteration % 10 == 0:
                progress(iteration / settings.iterations)
            after_step(model)
    return model


def supervised_anchors(model: AnchorModel, plates: list[CleanPlate]) -> AnchorModel:
    """The model without the anchors that no seen pixel of any training view vouches for.

    Left in, they show in test views as black blobs (under liquid that never left) and as haze (beyond the edges of the
    training images). The weight of a Gaussian in a set of pixels is the gradient of their summed colour with respect to
    its own colour.
    """
    device = model.positions.device
    weight = torch.zeros(len(model), device=device)
    for plate in plates:
        with torch.no_grad():
            means, factors, opacities, colors, _ = model.decode(plate.camera.center)
        color = torch.zeros_like(colors[:, :1]).requires_grad_()
        image, _ = rasterize(means, factors, opacities, color, plate.camera)
        image[..., 0][torch.as_tensor(plate.seen).to(device)].sum().backward()
        assert color.grad is not None
        weight += color.grad.view(len(model), -1).sum(dim=1)
    keep = torch.nonzero(weight >= _MIN_PIXELS)[:, 0]
    supervised = AnchorModel(len(keep), model.variant).to(device)
    rows = {"positions", *PER_ANCHOR}
    supervised.load_state_dict({name: t[keep] if name in rows else t for name, t in model.state_dict().items()})
    return supervised
