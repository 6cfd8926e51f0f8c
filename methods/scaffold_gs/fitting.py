"""Fits the anchors to the plates by gradient descent, then drops what no plate vouches for.

Loss .8 L1 + .2 (1 - SSIM) + .01 mean(prod scale), as in Scaffold-GS, over seen pixels; learning rates its own, decaying
over the run. No growth of anchors yet: the seeds cover every training pixel from the start.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray
from splashbench_methods.scaffold_gs.anchors import AnchorSeed
from splashbench_methods.scaffold_gs.model import AnchorModel
from splashbench_methods.scaffold_gs.plate import Plate
from splashbench_methods.scaffold_gs.settings import BackgroundSettings

from splashbench.render import rasterize
from splashbench.render.ssim import SsimTarget, ssim

_SSIM_WEIGHT = 0.2
_VOLUME_WEIGHT = 0.01
_DECAY = 0.1
# An anchor stays if it makes up at least this much of the seen pixels of all training views together.
_MIN_PIXELS = 0.5


def l1(image: torch.Tensor, target: torch.Tensor, weight: torch.Tensor) -> torch.Tensor:
    """Mean absolute difference of [H, W, 3] images over the pixels where `weight` [H, W] is 1."""
    return ((image - target).abs() * weight[..., None]).sum() / (3 * weight.sum()).clamp(min=1)


def fit_model(
    seed: AnchorSeed,
    plates: list[Plate],
    settings: BackgroundSettings,
    far_color: NDArray[np.float32],
    random_seed: int,
    progress: Callable[[float], None],
) -> AnchorModel:
    """Optimise a model that starts at `seed`; `progress` hears the fraction done."""
    torch.manual_seed(random_seed)
    rng = np.random.default_rng(random_seed)
    model = AnchorModel.from_seed(seed, settings.children, settings.view_dependent_shape)
    optimizer = torch.optim.Adam(
        [
            {"params": [model.offsets], "lr": 0.01},
            {"params": [model.features], "lr": 0.02},
            {"params": [model.log_scales], "lr": 0.01},
            {"params": model.opacity_head.parameters(), "lr": 0.002},
            {"params": model.shape_head.parameters(), "lr": 0.004},
            {"params": model.color_head.parameters(), "lr": 0.008},
        ],
        eps=1e-15,
    )
    schedule = torch.optim.lr_scheduler.ExponentialLR(optimizer, _DECAY ** (1 / settings.iterations))
    unit = float(np.median(seed.spacing))
    targets = [torch.as_tensor(plate.image) for plate in plates]
    weights = [torch.as_tensor(plate.seen.astype(np.float32)) for plate in plates]
    structures = [SsimTarget(plate.image, plate.seen.astype(np.float32)) for plate in plates]
    behind = torch.as_tensor(far_color)
    order: list[int] = []
    for iteration in range(settings.iterations):
        if not order:
            order = rng.permutation(len(plates)).tolist()
        view = order.pop()
        camera = plates[view].camera
        means, factors, opacities, colors, scales = model.decode(camera.center)
        image, _ = rasterize(means, factors, opacities, colors, camera, background=behind)
        loss = (1 - _SSIM_WEIGHT) * l1(image, targets[view], weights[view])
        loss = loss + _VOLUME_WEIGHT * (scales / unit).prod(dim=1).mean()
        if iteration % settings.ssim_every == 0:
            loss = loss + settings.ssim_every * _SSIM_WEIGHT * (1 - ssim(image, structures[view]))
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        optimizer.step()
        schedule.step()
        if iteration % 10 == 0:
            progress(iteration / settings.iterations)
    return model


def supervised_anchors(model: AnchorModel, plates: list[Plate]) -> AnchorModel:
    """The model without the anchors that no seen pixel of any training view vouches for.

    Left in, they show in test views as black blobs (under liquid that never left) and as haze (beyond the edges of the
    training images). The weight of a Gaussian in a set of pixels is the gradient of their summed colour with respect to
    its own colour.
    """
    n, k = len(model.positions), model.children_per_anchor
    weight = torch.zeros(n)
    for plate in plates:
        with torch.no_grad():
            drawn = torch.nonzero(model.opacities(plate.camera.center).reshape(-1) > 0)[:, 0]
            means, factors, opacities, colors, _ = model.decode(plate.camera.center)
        color = torch.zeros_like(colors).requires_grad_()
        image, _ = rasterize(means, factors, opacities, color, plate.camera)
        image[..., 0][torch.as_tensor(plate.seen)].sum().backward()
        assert color.grad is not None
        weight.index_add_(0, drawn // k, color.grad[:, 0])
    keep = torch.nonzero(weight >= _MIN_PIXELS)[:, 0]
    kept = AnchorModel(len(keep), k, model.view_dependent_shape)
    rows = {"positions", "features", "offsets", "log_scales"}
    kept.load_state_dict({name: t[keep] if name in rows else t for name, t in model.state_dict().items()})
    return kept
