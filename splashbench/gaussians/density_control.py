"""Adaptive density control (Kerbl et al. 2023, Sec. 5): Gaussians are cloned, split and pruned as the fit goes.

Where the loss pulls at a Gaussian's projection by more than a threshold on average, a small one is cloned and a large
one is split in two, drawn from itself and 1.6 times smaller. Faint ones are dropped. Opacities may be reset to almost
nothing now and then, so that what no view needs stays faint and goes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from splashbench.gaussians.dynamic_model import Splats, rotation_matrices
from splashbench.gaussians.optimizer import RowOptimizer
from splashbench.gaussians.screen_gradients import screen_gradients_of
from splashbench.scene import Camera

_SHRINK = 1.6
_RESET_OPACITY = 0.01


@dataclass(frozen=True)
class DensitySettings:
    """When and where primitives come and go. Steps are counted from the start of the fit.

    start, stop, every: rounds of growth and pruning. prune_until: pruning alone goes on to here. gradient: mean screen
    gradient above which a primitive is cloned or split. large: size above which it is split, scene units. opacity:
    below which it is pruned. max_gaussians: primitives at most. reset_every: steps between opacity resets, 0 for never.
    reset_until: after which there are none.
    """

    start: int
    stop: int
    every: int
    gradient: float
    large: float
    max_gaussians: int
    opacity: float = 0.005
    prune_until: int = 0
    reset_every: int = 0
    reset_until: int = 0


class DensityControl:
    """What was seen of every primitive since it was last judged, and the rounds of growth and pruning.

    The model has the tables positions, log_scales [N, 3], quaternions [N, 4] and opacity_logits [N]; `changed` may
    alter rows that were made from others (a mapping of all tables), such as their times.
    """

    def __init__(
        self,
        optimizer: RowOptimizer,
        settings: DensitySettings,
        changed: Callable[[dict[str, Tensor]], None] | None = None,
    ) -> None:
        self.optimizer, self.settings, self._changed = optimizer, settings, changed
        self._forget()

    def _forget(self) -> None:
        count = len(self.optimizer.model.get_parameter("positions"))
        device = self.optimizer.model.get_parameter("positions").device
        self._gradient = torch.zeros(count, device=device)
        self._visits = torch.zeros(count, dtype=torch.int32, device=device)

    def wants_gradients(self, step: int) -> bool:
        """Whether `observe` is to be called at `step`."""
        return step < self.settings.stop

    def observe(self, camera: Camera, splats: Splats, gradients: Tensor) -> None:
        """Take note of a view; gradients: of its loss by the means [N, 3]."""
        rows = slice(None) if splats.rows is None else splats.rows
        self._gradient[rows] += screen_gradients_of(camera, splats.means.detach(), gradients)
        self._visits[rows] += gradients.any(dim=1)

    def after_step(self, step: int) -> None:
        """What is due after step number `step`, counted from 0."""
        settings, done = self.settings, step + 1
        if done > settings.start and done % settings.every == 0:
            if done <= settings.stop:
                self._round()
            elif done <= settings.prune_until:
                self._replace(self._bright(), {})
        if settings.reset_every and done < settings.reset_until and done % settings.reset_every == 0:
            logits = self.optimizer.model.get_parameter("opacity_logits").detach()
            ceiling = float(np.log(_RESET_OPACITY / (1 - _RESET_OPACITY)))
            self.optimizer.set_rows("opacity_logits", logits.clamp(max=ceiling))

    def _bright(self) -> np.ndarray:
        """bool [N]: primitives to keep; never none, since a model of none could not be fitted further."""
        opacity = torch.sigmoid(self.optimizer.model.get_parameter("opacity_logits").detach()).cpu().numpy()
        bright = opacity >= self.settings.opacity
        if not bright.any():
            bright[opacity.argmax()] = True
        return bright

    @torch.no_grad()
    def _round(self) -> None:
        settings, model = self.settings, self.optimizer.model
        mean = self._gradient.cpu().numpy() / np.maximum(self._visits.cpu().numpy(), 1)
        bright = self._bright()
        mean[~bright] = 0
        chosen = np.flatnonzero(mean > settings.gradient)
        room = max(0, settings.max_gaussians - int(bright.sum()))
        chosen = np.sort(chosen[np.argsort(-mean[chosen], kind="stable")][:room])
        rows = torch.from_numpy(chosen).to(self._gradient.device)
        new = {name: model.get_parameter(name).detach()[rows] for name in self.optimizer.rows}
        scales = torch.exp(new["log_scales"])
        large = scales.max(dim=1).values > settings.large
        # A clone stays where it is; of a split, one half takes the old row's place and the other is new.
        drawn = torch.randn(2, len(rows), 3).to(scales) * scales * large[:, None]
        shift = (rotation_matrices(new["quaternions"]) @ drawn[..., None])[..., 0]
        smaller = new["log_scales"] - float(np.log(_SHRINK)) * large[:, None]
        new["log_scales"] = smaller
        halves = rows[large]
        self.optimizer.set_rows("positions", (new["positions"] + shift[1])[large], halves)
        self.optimizer.set_rows("log_scales", smaller[large], halves)
        new["positions"] = new["positions"] + shift[0]
        if self._changed is not None:
            self._changed(new)
        self._replace(bright, new)

    def append(self, new: dict[str, Tensor]) -> None:
        """Add primitives from elsewhere: rows of every table."""
        self._replace(np.ones(len(self.optimizer.model.get_parameter("positions")), bool), new)

    def _replace(self, keep: np.ndarray, new: dict[str, Tensor]) -> None:
        model = self.optimizer.model
        if not new:
            new = {name: model.get_parameter(name).detach()[:0] for name in self.optimizer.rows}
        self.optimizer.replace_rows(np.flatnonzero(keep), new)
        self._forget()
