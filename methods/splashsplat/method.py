"""The method SplashSplat by the harness's contract (paper, "Method"): observe, track, decode, render."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

import numpy as np
import torch

from splashbench.errors import SplashbenchError
from splashbench.gaussians.devices import CPU, GaussianMethod
from splashbench.gaussians.torch_threads import one_torch_thread
from splashbench.harness.contract import Fitted, Render, Run, Support
from splashbench.render import Frozen, freeze
from splashbench.scene.camera import Camera
from splashbench.scene.gaussians import Gaussians
from splashbench.scene.geometry import SignedDistance
from splashbench.scene.particles import Particles
from splashbench.scene.scene import TrainingScene
from splashbench.scene.velocity import VelocityField

from .appearance.compositing import composite
from .appearance.decoder import Children
from .carriers.between import carriers_at
from .carriers.subframe import CarrierState
from .course import Course
from .draft import State
from .fields.occlusion import LiquidOcclusion
from .flip.solver import metric_gravity
from .model import Liquid
from .panorama import Panorama, panorama
from .settings import VERSION, SplashSplatConfig

if TYPE_CHECKING:
    from ..scaffold_gs import Background

MIN_VIEWS = 2
# Eyes of which it is known what they see behind the liquid, at the most.
_EYES = 64


class FittedSplashSplat(Fitted):
    """Liquid and a frozen background. It lies in front, but for what the container hides; or, by the liquid's
    `composition`, the Gaussians of both are drawn together by depth."""

    def __init__(self, liquid: Liquid, background: Background, occlusion: LiquidOcclusion | None = None) -> None:
        self.liquid = liquid
        self.background = background
        self.occlusion = occlusion
        self._device, self._look = CPU, liquid.appearance
        self._background_image: tuple[Camera, np.ndarray] | None = None
        self._frozen: tuple[Camera, Frozen] | None = None
        # What each eye sees behind all of the liquid: exports ask for the same ones at every time.
        self._around: dict[tuple[float, ...], Panorama] = {}

    def to_device(self, device: str) -> None:
        """Decode and draw on `device` from now on; where carriers are, and what lies behind them, is the processor's
        to find."""
        self._device, self._look = device, self.liquid.appearance.to(device)

    def _background(self, camera: Camera) -> np.ndarray:
        # Videos ask for one camera many times in a row, and nothing in the background moves.
        # One look at the attribute: another thread may ask for another camera meanwhile.
        known = self._background_image
        if known is None or known[0] is not camera:
            known = self._background_image = camera, np.asarray(self.background.render(camera), dtype=np.float32)
        return known[1]

    def _frozen_background(self, camera: Camera) -> Frozen:
        known = self._frozen
        if known is None or known[0] is not camera:
            known = self._frozen = camera, freeze(*self.background.gaussians(camera), camera)
        return known[1]

    def children(self, camera: Camera, time: float) -> Children | None:
        """The Gaussians of the liquid as `camera` sees them at `time` (seconds); None where there is no liquid.

        Those that the container's near wall cuts are whole here.
        """
        shown = self._shown(camera, time)
        return None if shown is None else shown[0].to(CPU)

    @torch.no_grad()
    def _shown(self, camera: Camera, time: float) -> tuple[Children, tuple[torch.Tensor, torch.Tensor] | None] | None:
        """`children`, and what cuts them, see `LiquidOcclusion.cut`."""
        parts = [(ids, self._seen(camera, state)) for ids, state in self._carriers(time)]
        if not parts:
            return None
        children = self._decoded(parts, camera.center)
        places = np.concatenate([state.positions.numpy().astype(np.float64) for _, state in parts])
        cut = None if self.occlusion is None else self.occlusion.cut(camera, places)
        if cut is None:
            return children, None
        return children, (torch.from_numpy(cut[0]).to(self._device), torch.from_numpy(cut[1]).to(self._device))

    def _carriers(self, time: float) -> list[tuple[torch.Tensor, CarrierState]]:
        liquid = self.liquid
        shown = carriers_at(liquid.track, liquid.times, time, liquid.between_frames)
        return [(ids, state) for ids, state in shown if len(ids)]

    def _seen(self, camera: Camera, state: CarrierState) -> CarrierState:
        """`state` without what the container hides from `camera`."""
        if self.occlusion is None:
            return state
        seen = 1 - torch.from_numpy(self.occlusion.hidden(camera, state.positions.numpy().astype(np.float64)))
        return replace(state, visibility=seen if state.visibility is None else seen * state.visibility)

    def _decoded(self, carriers: list[tuple[torch.Tensor, CarrierState]], eye: np.ndarray) -> Children:
        look = self._look
        place = self._eye(eye)
        with one_torch_thread():
            parts = [
                look.decoder.decode(
                    look.features, look.log_scales, ids.to(self._device), state.to(self._device), place
                )[0]
                for ids, state in carriers
            ]
        tables = [[getattr(part, f.name) for part in parts] for f in fields(Children)]
        return Children(*(None if table[0] is None else torch.cat(table) for table in tables))

    def _eye(self, place: np.ndarray) -> torch.Tensor:
        return torch.tensor(place, dtype=torch.float32, device=self._device)

    @torch.no_grad()
    def render(self, camera: Camera, time: float) -> Render:
        """The view of `camera` at `time` (seconds), any time; between frames see carriers/between.py."""
        shown = self._shown(camera, time)
        if shown is None:
            background = self._background(camera)
            return Render(background.copy(), np.zeros(background.shape[:2], dtype=np.float32))
        children, cut = shown
        with one_torch_thread():
            if self.liquid.composition == "together":
                far = torch.from_numpy(self.background.far_color).to(self._device)
                rgb, alpha = composite(children, camera, far, self._frozen_background(camera))
            else:
                behind = torch.from_numpy(self._background(camera)).to(self._device)
                wall, in_front = cut or (None, None)
                glass = self._look.glass
                before = None if glass is None else glass.seen(self._eye(camera.center))
                rgb, alpha = composite(children, camera, behind, wall=wall, in_front=in_front, glass=before)
            return Render(rgb.clamp(0, 1).cpu().numpy(), alpha.clamp(0, 1).cpu().numpy())

    def particles(self) -> Particles:
        """The carriers."""
        return self.liquid.particles()

    def signed_distance(self) -> SignedDistance | None:
        """phi of every frame, as the carriers were held to it."""
        return self.liquid.signed_distance()

    def surface(self, time: float) -> SignedDistance | None:
        """phi at `time`: the two frames' around it, moved there by u_t and blended."""
        return self.liquid.surface(time)

    @torch.no_grad()
    def gaussians(self, time: float, eye: np.ndarray) -> Gaussians:
        """The carriers' children, coloured as `eye` [3] sees them; what the container hides is among them.

        Of transparent liquid the share of the background that is behind each is part of its colour.
        """
        carriers = self._carriers(time)
        if not carriers:
            return Gaussians.none()
        children = self._decoded(carriers, eye).to(CPU)
        colors = children.colors
        if children.transmittances is not None:
            share = children.transmittances[..., None]
            colors = (1 - share) * colors + share * self._behind(children.means, eye)
        parts = (children.means, children.factors, children.opacities, colors)
        return Gaussians(*(part.flatten(0, 1).numpy() for part in parts))

    def _behind(self, places: torch.Tensor, eye: np.ndarray) -> torch.Tensor:
        """The background's colour [n, K, 3] that `eye` sees behind `places` [n, K, 3]."""
        seen = tuple(float(value) for value in eye)
        # One look at the table: another thread may empty it meanwhile.
        around = self._around.get(seen)
        if around is None:
            around = panorama(self.background.render, eye, self.liquid.grid.corners())
            if len(self._around) >= _EYES:
                self._around.clear()
            self._around[seen] = around
        return torch.from_numpy(around.at(places.reshape(-1, 3).numpy())).reshape(places.shape)

    def static_gaussians(self, eye: np.ndarray) -> Gaussians:
        """The frozen background's, coloured as `eye` [3] sees them."""
        return Gaussians(*self.background.seen_from(eye))

    def empty_view(self, camera: Camera) -> np.ndarray:
        """The frozen background as `camera` sees it."""
        return self._background(camera).copy()

    def velocity(self, time: float) -> VelocityField | None:
        """u_t of the step that `time` lies in; None where others than u_t moved the carriers."""
        return self.liquid.velocity(time)

    def save(self, directory: Path) -> None:
        """The liquid's files, and the background under static/."""
        self.liquid.save(directory)
        static = directory / "static"
        static.mkdir(exist_ok=True)
        self.background.save(static)
        if self.occlusion is not None:
            self.occlusion.save(static)


class SplashSplat(GaussianMethod):
    """Carriers moved by a fitted velocity field, corrected and refilled by the hull, decoded into Gaussians."""

    id: ClassVar[str] = "splashsplat"
    title: ClassVar[str] = "SplashSplat"
    version: ClassVar[str] = VERSION
    budgets: ClassVar[tuple[str, ...]] = ("seconds", "storage_bytes", "memory_bytes")
    torch_optim: ClassVar[bool] = False
    Config = SplashSplatConfig

    def supports(self, scene: TrainingScene) -> Support:
        """Needs two training views. Where masks show no liquid, photographs are asked where it is."""
        if len(scene.train) < MIN_VIEWS:
            return Support(False, f"needs {MIN_VIEWS} training views, and has {len(scene.train)}")
        return Support(True)

    def fit(self, scene: TrainingScene, config: SplashSplatConfig, run: Run) -> FittedSplashSplat:
        """The parts of the fit, in the order of course.py.

        Raises SplashbenchError for a budget of memory elsewhere than on the processor: it was not measured there.
        """
        if run.budget.memory_bytes is not None and run.device != CPU:
            raise SplashbenchError("splashsplat keeps to a budget of memory on the processor alone; give --device cpu")
        if config.variant == "flip":
            metric_gravity(scene)  # an error now rather than after the background

        def show(state: Callable[[], State], milestone: bool) -> None:
            run.checkpoint(lambda: FittedSplashSplat(*state()), milestone)

        fitted = FittedSplashSplat(*Course(scene, config, run, show).taken())
        carriers, handed_out = fitted.liquid.carriers.count, len(fitted.liquid.handed_out)
        if handed_out < carriers:
            run.note("particles", f"{handed_out} of {carriers} carriers: a file holds no more of them")
        return fitted

    def load(self, directory: Path, scene: TrainingScene) -> FittedSplashSplat:
        """Read a saved model."""
        from ..scaffold_gs import Background

        static = directory / "static"
        return FittedSplashSplat(Liquid.load(directory), Background.load(static), LiquidOcclusion.load(static))
