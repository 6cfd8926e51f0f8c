"""Optimising features, base scales and heads by rendering (paper, "Optimization").

Each iteration takes one time-camera pair, decodes the carriers active then, rasterises them over the frozen
background and descends on the seven losses. Positions and deformations are given (carriers/) and stay as they are.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from splashbench.errors import SplashbenchError
from splashbench.gaussians.adam import Adam
from splashbench.gaussians.devices import CPU
from splashbench.native import memory

from ..carriers.subframe import Track
from ..kernel.window_loss import WindowPhotograph
from . import losses
from .active import Active, ActiveCarriers
from .averages import Averages, ShownHeads
from .compositing import composite, shares
from .contribution import contributions, least
from .decoder import Children, Decoder, DecoderSettings, Penalties, initial_log_scale
from .fit_settings import FitSettings
from .glass import Glass, GlassFit
from .optimizer import RowAdam
from .photographs import ReadAhead, read_now
from .schedule import (
    AdaptiveSchedule,
    Clock,
    Earned,
    EarningSchedule,
    FixedSchedule,
    Schedule,
    TimedSchedule,
    WithheldLook,
    withheld,
)
from .sensitivity import Sensitivities, Sensitivity
from .shared_features import SharedFeatures
from .targets import TrainingTarget

#: The liquid is drawn "over" an image of the background, or "together" with the background's Gaussians.
Composition = Literal["over", "together"]

# Iterations between two looks at the withheld photographs.
_LOOK_EVERY = 100
# Iterations that would take as long as all that comes before them does on most scenes.
_BEFORE = 1500
# Iterations in which the learning rates fall, as a share of those before.
_FALL = 0.5
# When transparent carriers are left out, as shares of the iterations: not in the last fifth, which makes up for them.
_PRUNINGS = tuple(tenth / 10 for tenth in range(1, 9))
# When it is looked at anew what makes up each photograph, likewise; and not before each was seen so many times: until
# then opacities say little.
_FOCUSINGS, _SEEN_BEFORE = (0.2, 0.4, 0.6, 0.8), 4
# With `idle_early` so much after the beginning as well, and once each was seen so many times.
_EARLY_FOCUSING, _SEEN_BEFORE_EARLY = 0.1, 1
# After so many iterations, and after each that drew so many pixels, what the heap holds of freed images is given back.
_GIVE_BACK_EVERY, _GIVE_BACK_PIXELS = 25, 1 << 20
# Share of the photographs that were seen before a state is shown. On opaque_bowl it is better than the draft then, in
# glass it is a decibel below for some seconds.
_SHOWN_FROM = 0.25
# The same of a fit that goes on from coarse grids, whose last state is better than the first ones on others. (Losses of
# both say little, as plates lay behind most coarse ones: to wait for a smaller one took glass_tank a minute more.)
_SHOWN_AGAIN_FROM = 1.25


@dataclass
class Appearance:
    """What the fit learns: features [count, size] and log_scales [count, 3] of the carriers, the heads, and the glass
    before the liquid, where it is in a transparent container."""

    features: Tensor
    log_scales: Tensor
    decoder: Decoder
    glass: Glass | None = None

    def to(self, device: str) -> Appearance:
        """On `device`: this itself where it is there, else a copy."""
        if self.features.device.type == torch.device(device).type:
            return self
        return Appearance(
            self.features.to(device),
            self.log_scales.to(device),
            copy.deepcopy(self.decoder).to(device),
            None if self.glass is None else self.glass.to(device),
        )

    def become(self, other: Appearance) -> None:
        """Take over all that `other` has learned."""
        self.features, self.log_scales, self.decoder, self.glass = (
            other.features,
            other.log_scales,
            other.decoder,
            other.glass,
        )


#: Given the number of a target, features and log-scales of all carriers, and by how much the opacity of each is
#: multiplied (float32 [count], None for 1): the window as these would show it.
Drawn = Callable[[int, Tensor, Tensor, Tensor | None], Tensor]


@dataclass(frozen=True)
class Fit:
    """losses: of every iteration; `begun` others came before. left: bool [count], the carriers that were fitted to the
    end. sensitivity: of the photographs to what was learned; None where it was not asked for. drawn: see `Drawn`.
    photograph: of a target, by its number, which may have to be read. photographs: how many targets. earned: what
    stretches of iterations bought, where that decided how many there were.
    """

    losses: list[float]
    left: np.ndarray
    sensitivity: Sensitivity | None
    drawn: Drawn
    photograph: Callable[[int], WindowPhotograph]
    photographs: int
    earned: tuple[Earned, ...] = ()
    begun: int = 0


class _Moments:
    """Shares of the fit at which something is due: of `iterations`, the first `begun` of which were made elsewhere, or
    of what the schedule says is done."""

    def __init__(self, shares: Sequence[float], iterations: int, begun: int, by_schedule: bool) -> None:
        self._iterations = {round(share * iterations) - begun for share in shares}
        self._left = sorted(shares) if by_schedule else None

    def come(self, iteration: int, schedule: Schedule) -> bool:
        """Whether one is due before this iteration."""
        if self._left is None:
            return iteration in self._iterations
        done, before = schedule.done(iteration), len(self._left)
        self._left = [share for share in self._left if share > done]
        return len(self._left) < before


def initial_appearance(
    count: int, voxel: float, settings: FitSettings, decoder: DecoderSettings, seed: int
) -> Appearance:
    """Appearance before the fit; the same for the same seed."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        features = 0.1 * torch.randn(count, decoder.feature_size)
        heads = Decoder(decoder)
    return Appearance(features, torch.full((count, 3), initial_log_scale(settings.base_scale, voxel)), heads)


def image_loss(
    image: Tensor,
    alpha: Tensor,
    photograph: WindowPhotograph,
    area: float,
    weights: losses.LossWeights,
    ssim_weight: float,
) -> Tensor:
    """The weighted sum of the terms that compare images (Eq. total_loss); `ssim_weight` replaces weights.ssim.

    area: pixels over which the silhouette term averages.
    """
    terms = losses.image_terms(image, alpha, photograph, ssim_weight > 0)
    loss = weights.foreground * terms.foreground + weights.gradient * terms.gradient
    loss = loss + weights.silhouette * terms.silhouette / area
    if terms.ssim is not None:
        loss = loss + ssim_weight * (1 - terms.ssim)
    if weights.beside > 0:
        truth = photograph.image.to(torch.float32) / 255
        loss = loss + weights.beside * losses.beside_loss(image[photograph.box], truth, photograph.mask)
    return loss


def masked_psnr(image: Tensor, photograph: WindowPhotograph) -> float:
    """PSNR of a window within the photograph's mask, dB."""
    inside = image[photograph.box][photograph.mask].clamp(0, 1)
    error = (inside - photograph.image[photograph.mask].to(torch.float32) / 255).square().mean()
    return -10 * math.log10(max(float(error), 1e-10)) if len(inside) else 0.0


def penalty_loss(penalties: Penalties, voxel: float, weights: losses.LossWeights) -> Tensor:
    """The weighted sum of the other terms."""
    return (
        weights.covariance * penalties.covariance / voxel**2
        + weights.separation * penalties.separation
        + weights.color * penalties.color
    )


def _schedule(settings: FitSettings, count: int, clock: Clock | None, seed: int) -> tuple[Schedule, np.ndarray]:
    """The schedule of a fit to `count` photographs, and which of them it may withhold: bool [count]."""
    chosen, none = withheld(count, settings.validation_share, np.random.default_rng([seed, 3])), np.zeros(count, bool)
    if clock is not None:
        return TimedSchedule(settings.iterations, clock), none
    fixed = FixedSchedule(settings.iterations, settings.anneal, settings.begun, settings.handed_on)
    if settings.validation_share == 0 or settings.handed_on:
        return fixed, chosen if settings.handed_on else none
    adaptive: AdaptiveSchedule | EarningSchedule = (
        EarningSchedule(settings.iterations, _LOOK_EVERY, settings.price, _BEFORE, _FALL, settings.begun)
        if settings.price > 0
        else AdaptiveSchedule(settings.iterations, _LOOK_EVERY, settings.stop_gain, _FALL)
    )
    if not adaptive.may_stop:
        return adaptive, none
    return (adaptive, chosen) if chosen.any() else (fixed, none)


def _fitted(withheld_targets: np.ndarray, withholds: bool) -> np.ndarray:
    """The photographs that the fit sees next, int64 [n]: all others while some are withheld (bool [count]); afterwards
    all of them, and those that were withheld twice, to catch up."""
    others, late = np.flatnonzero(~withheld_targets), np.flatnonzero(withheld_targets)
    return others if withholds else np.concatenate([np.arange(len(withheld_targets)), late])


def fit_appearance(
    appearance: Appearance,
    track: Track,
    targets: list[TrainingTarget],
    settings: FitSettings,
    color_cell: float,
    seed: int,
    progress: Callable[[float], None],
    offer: Callable[[Callable[[], tuple[Appearance, np.ndarray]], bool], None] | None = None,
    settle: Callable[[], None] | None = None,
    enlarge: Callable[[], None] | None = None,
    clock: Clock | None = None,
    device: str = CPU,
) -> Fit:
    """Fit `appearance` in place. `color_cell`: in transport voxels.

    offer: is given, after every iteration once some photographs were seen, what makes the appearance as it is, but for
    heads that are means over the last steps, and the carriers still fitted: bool [count]; and whether there will be no
    other for a while. settle: is called once, after the share `plates_share`, to put the background behind `targets`.
    enlarge: is called once, where targets have smaller ones and before they themselves teach, to put it behind them.
    clock: where given, the fit ends when it has run out, and `iterations` are the most that there are. device: where it
    is fitted; `targets` have their backgrounds there. What is given and handed out lies on the CPU.

    Raises SplashbenchError where the loss stops being finite.
    """
    look = appearance.to(device)
    glass = None if look.glass is None else GlassFit(look.glass, track.grid.voxel)
    if glass is None:
        settings = replace(settings, weights=replace(settings.weights, beside=0.0))
    carriers = ActiveCarriers(track, color_cell)
    decoder = look.decoder
    parameters = list(decoder.parameters())
    heads = Adam([{"params": parameters, "lr": settings.learning_rate_heads}])
    scales = RowAdam(look.log_scales, settings.learning_rate_scales)
    features = SharedFeatures(
        look.features,
        track.carriers,
        carriers.ids,
        settings.feature_cells,
        settings.still_cell,
        settings.learning_rate_features,
        settings.learning_rate_cells,
        seed,
    )
    rng = np.random.default_rng([seed, 1])
    size = look.features.shape[1] + look.log_scales.shape[1]
    measured = Sensitivities(track.carriers.count, size, device) if settings.measured_share > 0 else None
    schedule, withheld_targets = _schedule(settings, len(targets), clock, seed)
    shown_heads = None if offer is None else ShownHeads(decoder)
    averages: Averages | None = None
    if isinstance(schedule, EarningSchedule) and schedule.withholds:
        averages = Averages(track.carriers.count, size, decoder)

    def shown(children: Children, target: TrainingTarget, active: Active) -> tuple[Tensor, Tensor]:
        before = None if glass is None else glass.glass.seen(target.eye)
        return composite(
            children,
            target.camera,
            target.background,
            target.frozen,
            target.modes,
            target.wall,
            active.in_front,
            before,
        )

    def seen(
        target: TrainingTarget, active: Active, values: list[Tensor], penalised: bool
    ) -> tuple[Tensor, Tensor, Penalties | None]:
        cells = active.cells if penalised else None
        children, penalty_terms = decoder.decode(values[0], values[1], None, active.state, target.eye, cells)
        return *shown(children, target, active), penalty_terms

    def learned(t: int, active: Active) -> list[Tensor]:
        return [features.of_frame(t, active.places), look.log_scales.index_select(0, active.ids)]

    @torch.no_grad()
    def transparent() -> Tensor:
        opacities = torch.cat([decoder.mean_opacity(block) for block in features.blocks()])
        return (opacities < settings.prune_opacity).cpu()

    @torch.no_grad()
    def withheld_look() -> WithheldLook:
        weights, total, quality = settings.weights, 0.0, []
        for number in np.nonzero(withheld_targets)[0]:
            target = targets[number].coarse or targets[number]  # of one size at all looks
            active, target = carriers.of(target).to(device), target.to(device)
            values = learned(target.frame, active)
            if averages is not None:
                mean = averages.of(active.ids, torch.cat(values, dim=1))
                values = list(mean.split([values[0].shape[1], values[1].shape[1]], dim=1))
            image, alpha, _ = seen(target, active, [table.contiguous() for table in values], penalised=False)
            photograph = read_now(target.photograph).to(device)
            total += float(image_loss(image, alpha, photograph, target.area, weights, weights.ssim))
            quality.append(masked_psnr(image, photograph))
        return WithheldLook(total / int(withheld_targets.sum()), np.array(quality))

    @torch.no_grad()
    def idle(target: TrainingTarget, active: Active) -> Tensor:
        active = active.to(device)
        # Colours of all tiles: liquid drawn beside the mask is to be taught that it does not belong there.
        whole = replace((target.coarse or target).to(device), modes=None)
        feature_rows, scale_rows = learned(target.frame, active)
        children, _ = decoder.decode(feature_rows, scale_rows, None, active.state, whole.eye)
        if device == CPU:
            before = None if glass is None else glass.glass.seen(target.eye)
            found = shares(children, whole.camera, whole.frozen, whole.wall, active.in_front, before)
            return least(found, settings.idle_share)

        def drawn(colors: Tensor) -> Tensor:
            return shown(replace(children, colors=colors, transmittances=None), whole, active)[0]

        return least(contributions(children.colors, drawn), settings.idle_share).cpu()

    @torch.no_grad()
    def state() -> tuple[Appearance, np.ndarray]:
        assert shown_heads is not None
        so_far = Appearance(features.all(), look.log_scales, shown_heads.decoder(), look.glass)
        return so_far.to(CPU), carriers.left(track.carriers.count)

    @torch.no_grad()
    def drawn(number: int, every_feature: Tensor, every_scale: Tensor, opacity: Tensor | None) -> Tensor:
        target = targets[number].to(device)
        active = carriers.of(targets[number])
        if opacity is not None:
            left, before = opacity.index_select(0, active.ids), active.state.visibility
            active = replace(active, state=replace(active.state, visibility=left if before is None else left * before))
        values = [table.index_select(0, active.ids).to(device) for table in (every_feature, every_scale)]
        active = active.to(device)
        children, _ = decoder.decode(values[0], values[1], None, active.state, target.eye)
        return shown(children, replace(target, modes=None), active)[0].cpu()

    def photograph_of(number: int) -> WindowPhotograph:
        return read_now(targets[number].photograph)

    def sized(target: TrainingTarget, iteration: int) -> TrainingTarget:
        """`target` in the size that it has at `iteration`."""
        done = schedule.done(iteration)
        for share in (settings.coarse_share, settings.coarsest_share):
            if done < share and target.coarse is not None:
                target = target.coarse
        return target

    def leave_smaller_ones() -> None:
        for target in targets:
            target.coarse = None  # large, and not wanted any more
        if enlarge is not None:
            enlarge()

    reader = ReadAhead()
    begun = settings.begun / max(settings.iterations, 1)
    # What is transparent by what was handed on is left out at once; idle carriers are not looked for by that alone.
    early, seen_before = ([begun + _EARLY_FOCUSING], _SEEN_BEFORE_EARLY) if settings.idle_early else ([], _SEEN_BEFORE)
    looks = [*early, *(share for share in _FOCUSINGS if round(share * settings.iterations) > settings.begun)]
    prunings, focusings = (
        _Moments(shares, settings.iterations, settings.begun, clock is not None) for shares in (_PRUNINGS, looks)
    )
    shown_from = round((_SHOWN_FROM if settings.begun == 0 else _SHOWN_AGAIN_FROM) * len(targets))
    queue: list[int] = []
    history: list[float] = []
    iteration = 0
    while True:
        if schedule.due(iteration):
            with nullcontext() if averages is None else averages.heads():
                found = withheld_look()
            schedule.look(iteration, found)
        factor = schedule.factor(iteration)
        if settle is not None and (factor is None or schedule.done(iteration) >= settings.plates_share):
            if offer is not None and iteration >= shown_from:
                offer(state, True)
            settle()
            settle = None
        if factor is None:
            break
        if targets[0].coarse is not None and schedule.done(iteration) >= settings.coarse_share:
            leave_smaller_ones()
        if not queue:
            queue = rng.permutation(_fitted(withheld_targets, schedule.withholds)).tolist()
        if settings.prune_opacity > 0 and prunings.come(iteration, schedule):
            carriers.drop(transparent())
            features.keep(carriers.ids)
        if (
            settings.idle_share > 0
            and focusings.come(iteration, schedule)
            and settings.begun + iteration >= seen_before * len(targets)
        ):
            carriers.focus(idle, targets)
            features.keep(carriers.ids)
        target = targets[queue.pop()]
        active = carriers.of(target).to(device)
        values = [table.requires_grad_() for table in learned(target.frame, active)]
        target = sized(target, iteration).to(device)
        photograph = reader.get(target.photograph).to(device)
        if queue:
            reader.prepare(sized(targets[queue[-1]], iteration + 1).photograph)
        image, alpha, penalty_terms = seen(target, active, values, penalised=True)
        assert penalty_terms is not None
        with_ssim = iteration % settings.ssim_every == 0
        ssim_weight = settings.weights.ssim * settings.ssim_every if with_ssim else 0.0
        loss = image_loss(image, alpha, photograph, target.area, settings.weights, ssim_weight)
        loss = loss + penalty_loss(penalty_terms, track.grid.voxel, settings.weights)
        history.append(float(loss.detach()))
        if not math.isfinite(history[-1]):
            raise SplashbenchError(
                f"the loss of splashsplat is {history[-1]} at iteration {iteration + 1}; lower the learning rates"
            )
        panes = [] if glass is None else glass.parameters
        by_feature, by_scale, *others = torch.autograd.grad(loss, [*values, *parameters, *panes])
        for parameter, gradient in zip(parameters, others):
            parameter.grad = gradient
        if measured is not None and schedule.done(iteration) >= 1 - settings.measured_share:
            measured.add(active.ids, torch.cat([by_feature, by_scale], dim=1))
        for group in heads.param_groups:
            group["lr"] = settings.learning_rate_heads * factor
        heads.step()
        if shown_heads is not None:
            shown_heads.add()
        features.step(target.frame, by_feature, factor, active.places)
        scales.step(active.ids, by_scale, factor)
        if averages is not None and not schedule.withholds:
            averages = None  # large, and not wanted any more
        if averages is not None:
            averages.add(active.ids, torch.cat(learned(target.frame, active), dim=1))
        if glass is not None:
            glass.step(others[len(parameters) :], factor)
        iteration += 1
        if iteration % _GIVE_BACK_EVERY == 0 or alpha.numel() >= _GIVE_BACK_PIXELS:
            memory.give_back()
        progress((schedule.done(iteration) - begun) / (1 - begun))
        if offer is not None and iteration >= shown_from:
            offer(state, False)
    reader.close()
    if targets[0].coarse is not None:
        leave_smaller_ones()  # what is stored how coarsely is asked of the photographs themselves
    if glass is not None:
        glass.done()
    look.features = features.joined()
    appearance.become(look.to(CPU))
    return Fit(
        history,
        carriers.left(track.carriers.count),
        None if measured is None else measured.found(),
        drawn,
        photograph_of,
        len(targets),
        tuple(schedule.earned) if isinstance(schedule, EarningSchedule) else (),
        settings.begun,
    )


@torch.no_grad()
def visible_carriers(appearance: Appearance, threshold: float) -> np.ndarray:
    """bool [count]: carriers whose learned opacity reached `threshold`; the others are phantoms of the hull."""
    return (appearance.decoder.mean_opacity(appearance.features) >= threshold).numpy()
