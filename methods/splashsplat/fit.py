"""Optimising features, base scales and heads by rendering (paper, "Optimization").

Each iteration takes one time-camera pair, decodes the carriers active then, rasterises them over the frozen
background and descends on the seven losses. Carriers' positions and deformations are given (carriers.py) and stay as
they are.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import torch
from splashbench_methods.splashsplat import losses
from splashbench_methods.splashsplat.carriers import Carriers
from splashbench_methods.splashsplat.decoder import (
    CarrierState,
    Children,
    Decoder,
    DecoderSettings,
    initial_log_scale,
)
from splashbench_methods.splashsplat.optimizer import RowAdam
from splashbench_methods.splashsplat.targets import Target
from torch import Tensor

from splashbench.errors import SplashbenchError
from splashbench.observe.grid import Grid
from splashbench.render import rasterize
from splashbench.scene.camera import Camera


@dataclass(frozen=True)
class FitSettings:
    """Settings of the optimisation.

    ssim_every: the SSIM term enters every so many iterations, weighted up by as much.
    anneal: whether the learning rates fall along a half cosine.
    """

    iterations: int = 1000
    learning_rate_features: float = 5e-3
    learning_rate_heads: float = 5e-3
    learning_rate_scales: float = 1e-2
    anneal: bool = True
    ssim_every: int = 1
    base_scale: float = 0.35
    weights: losses.LossWeights = field(default_factory=losses.LossWeights)


@dataclass
class Appearance:
    """What the fit learns: features [count, size] and log_scales [count, 3] of the carriers, and the heads."""

    features: Tensor
    log_scales: Tensor
    decoder: Decoder


def initial_appearance(
    count: int, voxel: float, settings: FitSettings, decoder: DecoderSettings, seed: int
) -> Appearance:
    """Appearance before the fit; the same for the same seed."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        features = 0.1 * torch.randn(count, decoder.feature_size)
        heads = Decoder(decoder)
    return Appearance(features, torch.full((count, 3), initial_log_scale(settings.base_scale, voxel)), heads)


def composite(children: Children, camera: Camera, background: Tensor) -> tuple[Tensor, Tensor]:
    """Liquid over the background (liquid in front): rgb [h, w, 3] and the liquid's opacity [h, w]."""
    image: Tensor
    alpha: Tensor
    image, alpha = rasterize(
        children.means.flatten(0, 1),
        children.factors.flatten(0, 1),
        children.opacities.flatten(),
        children.colours.flatten(0, 1),
        camera,
        background=background,
    )
    return image, alpha


def total_loss(
    children: Children,
    image: Tensor,
    alpha: Tensor,
    target: Target,
    cells: tuple[Tensor, Tensor],
    voxel: float,
    weights: losses.LossWeights,
    ssim_weight: float,
) -> Tensor:
    """The weighted sum of all terms (Eq. total_loss); `ssim_weight` replaces weights.ssim."""
    truth = target.image.to(torch.float32) / 255
    mask = target.mask.to(torch.float32)
    near = target.box
    loss = weights.foreground * losses.foreground_loss(image[near], truth[near], mask[near])
    loss = loss + weights.gradient * losses.gradient_loss(image[near], truth[near], mask[near])
    if ssim_weight > 0:
        loss = loss + ssim_weight * losses.ssim_loss(image[near], truth[near])
    loss = loss + weights.silhouette * losses.silhouette_loss(alpha, mask, target.area)
    loss = loss + weights.covariance * losses.covariance_loss(children.factors, voxel)
    if weights.separation > 0:
        loss = loss + weights.separation * losses.separation_loss(children.offsets)
    if weights.colour > 0:
        loss = loss + weights.colour * losses.colour_loss(children.colours, *cells)
    return loss


def frame_states(carriers: Carriers, grid: Grid) -> list[CarrierState]:
    """Decoder input of every frame, positions in scene units."""
    states = []
    for t in range(carriers.n_frames):
        rows = carriers.rows(t)
        positions = torch.from_numpy(grid.to_scene(carriers.positions[rows]).astype(np.float32))
        deformation = torch.from_numpy(carriers.deformation[rows])
        states.append(CarrierState(positions, deformation, torch.from_numpy(carriers.phi[rows])))
    return states


def _colour_cells(carriers: Carriers, t: int, size: float) -> tuple[Tensor, Tensor]:
    """Cell of each carrier of frame `t`, and each cell's population; cells of `size` transport voxels."""
    keys = np.floor(carriers.positions[carriers.rows(t)] / size).astype(np.int64)
    _, cells, counts = np.unique(keys, axis=0, return_inverse=True, return_counts=True)
    return torch.from_numpy(cells.reshape(-1)), torch.from_numpy(counts.astype(np.float32))


def fit_appearance(
    appearance: Appearance,
    carriers: Carriers,
    grid: Grid,
    targets: list[Target],
    settings: FitSettings,
    colour_cell: float,
    seed: int,
    progress: Callable[[float], None],
) -> list[float]:
    """Fit `appearance` in place; the loss of every iteration is returned. `colour_cell`: in transport voxels.

    Raises SplashbenchError where the loss stops being finite.
    """
    states = frame_states(carriers, grid)
    ids = [torch.from_numpy(carriers.ids[carriers.rows(t)].astype(np.int64)) for t in range(len(states))]
    cells = [_colour_cells(carriers, t, colour_cell) for t in range(len(states))]
    heads = torch.optim.Adam(appearance.decoder.parameters(), lr=settings.learning_rate_heads)
    tables = (
        RowAdam(appearance.features, settings.learning_rate_features),
        RowAdam(appearance.log_scales, settings.learning_rate_scales),
    )
    rng = np.random.default_rng([seed, 1])
    queue: list[int] = []
    history: list[float] = []
    for iteration in range(settings.iterations):
        if not queue:
            queue = rng.permutation(len(targets)).tolist()
        target = targets[queue.pop()]
        active = ids[target.frame]
        rows = [table.table.index_select(0, active).requires_grad_() for table in tables]
        children = appearance.decoder(*rows, states[target.frame], target.eye)
        image, alpha = composite(children, target.camera, target.background)
        with_ssim = iteration % settings.ssim_every == 0
        ssim_weight = settings.weights.ssim * settings.ssim_every if with_ssim else 0.0
        loss = total_loss(
            children, image, alpha, target, cells[target.frame], grid.voxel, settings.weights, ssim_weight
        )
        history.append(float(loss.detach()))
        if not math.isfinite(history[-1]):
            raise SplashbenchError(
                f"the loss of splashsplat is {history[-1]} at iteration {iteration + 1}; lower the learning rates"
            )
        heads.zero_grad()
        loss.backward()
        factor = 1.0
        if settings.anneal:
            factor = 0.02 + 0.98 * 0.5 * (1 + math.cos(math.pi * iteration / settings.iterations))
        for group in heads.param_groups:
            group["lr"] = settings.learning_rate_heads * factor
        heads.step()
        for table, row in zip(tables, rows):
            table.step(active, row.grad, factor)
        progress((iteration + 1) / settings.iterations)
    return history


@torch.no_grad()
def visible_carriers(appearance: Appearance, threshold: float) -> np.ndarray:
    """bool [count]: carriers whose learned opacity reached `threshold`; the others are phantoms of the hull."""
    return (appearance.decoder.mean_opacity(appearance.features) >= threshold).numpy()
