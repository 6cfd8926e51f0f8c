"""Fits a dynamic model to the training photographs by gradient descent.

Loss .8 L1 + .2 (1 - SSIM) on whole images (Kerbl et al. 2023, Eq. 7), the mean over the views of a step, and what
the model penalises.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from splashbench.errors import SplashbenchError
from splashbench.gaussians.color_loss import l1
from splashbench.gaussians.dynamic_model import DynamicModel, Splats
from splashbench.gaussians.optimizer import RowOptimizer
from splashbench.gaussians.photographs import Photographs
from splashbench.gaussians.ssim import SsimTarget, ssim, ssim_by_torch
from splashbench.scene import Camera

_SSIM_WEIGHT = 0.2


class PrimitiveControl(Protocol):
    """How primitives come and go: density_control.py, or a method's own."""

    def wants_gradients(self, step: int) -> bool:
        """Whether `observe` is to be called at `step`."""
        ...

    def observe(self, camera: Camera, splats: Splats, gradients: Tensor) -> None:
        """Take note of a view; gradients: of its loss by the means [N, 3]."""
        ...

    def after_step(self, step: int) -> None:
        """What is due after step number `step`, counted from 0."""
        ...


@dataclass(frozen=True)
class FitHistory:
    """How the fit went: PSNR [steps] in dB of the training photographs, whole images, each as it was rendered."""

    psnr: NDArray[np.float32]

    def gained_in_last_quarter(self) -> float:
        """What the last quarter of the steps gained, dB: the mean of its second half, over the eighth before it."""
        steps = len(self.psnr)
        eighth = max(1, steps // 8)
        return float(self.psnr[steps - eighth :].mean() - self.psnr[steps - 3 * eighth : steps - 2 * eighth].mean())


def fit_dynamic(
    model: DynamicModel,
    optimizer: RowOptimizer,
    density: PrimitiveControl,
    photographs: Photographs,
    progress: Callable[[float], None],
    begin_step: Callable[[int], float] = lambda step: 0.0,
    after_step: Callable[[], None] = lambda: None,
) -> FitHistory:
    """Fit `model` in place, over the optimizer's iterations.

    begin_step: called before every step; what it returns is added to the step's times, such as noise.
    after_step: called after every step, to offer the model as it is (`Run.checkpoint`).

    Raises SplashbenchError where the loss stops being finite.
    """
    psnr = np.zeros(optimizer.iterations, np.float32)
    for step in range(optimizer.iterations):
        shift = begin_step(step)
        views = photographs.next()
        total: Tensor | None = None
        seen: list[tuple[Camera, Splats, Tensor]] = []
        errors = []
        states: dict[float, object] = {}
        for view in views:
            time = view.time + shift
            if time not in states:
                states[time] = model.at(time)
            splats = model.splats(states[time], view.camera)
            # A view's own gradient by the means is wanted, not the sum over the views.
            splats.means = splats.means.clone()
            splats.means.retain_grad()
            image = model.view(splats, view.camera, time)
            loss, error = _loss_and_error(image, view.image)
            if splats.penalty is not None:
                loss = loss + splats.penalty
            total = loss if total is None else total + loss
            seen.append((view.camera, splats, image))
            errors.append(error)
        assert total is not None
        loss = total / len(views)
        if not math.isfinite(float(loss.detach())):
            raise SplashbenchError(
                f"the loss is {float(loss.detach())} at iteration {step + 1}; lower the rates, by rate_factor and what "
                "other factors of rates the method has"
            )
        loss.backward()
        if density.wants_gradients(step):
            for camera, splats, _ in seen:
                if splats.means.grad is not None:
                    density.observe(camera, splats, splats.means.grad * len(views))
        optimizer.step()
        density.after_step(step)
        psnr[step] = -10 * math.log10(max(float(np.mean([float(error) for error in errors])), 1e-10))
        if step % 10 == 0:
            progress(step / optimizer.iterations)
        after_step()
    return FitHistory(psnr)


def _loss_and_error(image: Tensor, photograph: NDArray[np.uint8]) -> tuple[Tensor, Tensor | float]:
    """The loss of `image` [H, W, 3] against a photograph of that size, and the mean squared error."""
    if image.device.type != "cpu":
        return _on_device(image, photograph)
    truth = photograph * np.float32(1 / 255)
    loss = (1 - _SSIM_WEIGHT) * l1(image, photograph, np.ones(photograph.shape[:2], bool))
    loss = loss + _SSIM_WEIGHT * (1 - ssim(image, SsimTarget(truth)))
    return loss, float(((image.detach().numpy() - truth) ** 2).mean())


def _on_device(image: Tensor, photograph: NDArray[np.uint8]) -> tuple[Tensor, Tensor]:
    """The same where `image` lies; the error stays there until the step is done."""
    truth = torch.tensor(photograph, device=image.device) / 255
    loss = (1 - _SSIM_WEIGHT) * (image - truth).abs().mean()
    loss = loss + _SSIM_WEIGHT * (1 - ssim_by_torch(image, truth.permute(2, 0, 1)))
    return loss, (image.detach() - truth).square().mean()
