"""A reconstruction whose liquid has another dye: light is solved for anew, shape and background stay.

The recorded liquid is taken apart into what its own dye explains, and the rest: highlights, which no dye colours, and
shading, which every dye has. The new dye's light takes the place of the first; the rest stays as it was filmed. So
ripples and highlights of the recording are kept, as in the paper's figure.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from splashbench.dyes import REFERENCE_METRES, Dye
from splashbench.errors import SplashbenchError
from splashbench.harness.contract import Fitted, Render
from splashbench.replay import Reconstruction
from splashbench.replay.interface import Interface, cast
from splashbench.restyle.filmed_dye import FilmedDye, filmed_dye, require_optics
from splashbench.restyle.optics import facing, reflectance, seen_through, smoothed, transmittance
from splashbench.scene import Camera, Particles, SignedDistance, VelocityField
from splashbench.srgb import to_linear, to_srgb

Image = NDArray[np.float32]

# What no dye explains may make the liquid this much darker or brighter; beyond, the explanation is wrong.
_SHADING = (0.3, 3.0)
# Of the shading, what is kept where all light comes through the liquid: there it is of the background as well.
_KEPT_SEEN_THROUGH = 0.5
_LEAST_LIGHT = 1e-3
# Density of an opaque dye: by amber's red, the least that a named dye with a colour absorbs, .01 mm leave no light.
_OPAQUE = 1e6
# Below this opacity the liquid's own light is not told from noise.
_LEAST_COVER = 0.1
# The liquid's outline is the carriers'; where no ray meets the surface beside it, what is nearest to it counts.
_LEAST_OPACITY = 1 / 255


@dataclass
class Buffers:
    """A restyled view and what it was made of, for compositing.

    Attributes:
        rgb: [H, W, 3] linear light, liquid and background together.
        alpha: [H, W] opacity of the liquid, as the method renders it: where its dye is, not how dark.
        background: [H, W, 3] linear light, without liquid and not refracted.
        interface: the surface: depth, normals in the scene's axes, way within the liquid (scene units).
    """

    rgb: Image
    alpha: Image
    background: Image
    interface: Interface


class Restyled(Fitted):
    """The model of `reconstruction` with the dye `new` in place of `filmed`.

    new: its absorption per scene unit. light: how bright white is where the liquid is, as linear light; the new dye's
    thick layers have `light` times its albedo.
    """

    def __init__(self, reconstruction: Reconstruction, filmed: FilmedDye, new: Dye, light: float = 1.0) -> None:
        self._reconstruction, self.filmed, self.new, self.light = reconstruction, filmed, new, light

    def render(self, camera: Camera, time: float) -> Render:
        """The restyled view."""
        buffers = self.buffers(camera, time)
        return Render(to_srgb(buffers.rgb), buffers.alpha)

    def buffers(self, camera: Camera, time: float) -> Buffers:
        """The restyled view in linear light, with the buffers that it was made of."""
        rendered, behind = self._reconstruction.render(camera, time), self._reconstruction.empty_view(camera)
        surface = self._reconstruction.surface(time)
        assert behind is not None
        assert surface is not None
        interface, background = smoothed(cast(surface, camera), camera), to_linear(behind)
        light = to_linear(rendered.rgb)
        rgb = light
        if (rendered.alpha > _LEAST_OPACITY).any():
            interface = _completed(interface, rendered.alpha, surface.voxel)
            rgb = self._relit(light, rendered.alpha, background, interface, camera)
        return Buffers(rgb, rendered.alpha, background, interface)

    def _relit(self, light: Image, alpha: Image, background: Image, interface: Interface, camera: Camera) -> Image:
        filmed = self.filmed
        through = seen_through(background, interface, camera, filmed.index)
        cover = alpha[..., None]
        # The liquid alone: at its outline the picture is of both, and what was filmed must not stay there.
        liquid = np.maximum((light - (1 - cover) * background) / np.maximum(cover, _LEAST_COVER), 0)
        # The room in the surface is no brighter than what was filmed there: a normal that says so is wrong.
        most = liquid.min(-1, keepdims=True) / max(filmed.mirrored, _LEAST_LIGHT)
        mirrored = np.minimum(reflectance(facing(interface, camera))[..., None], most)
        passed = transmittance(interface.length, filmed.absorption) if not filmed.opaque else np.zeros_like(light)
        before = self._explained(through, mirrored, passed, filmed.returned)
        returned = self.light * self.new.albedo.astype(np.float64)
        after = self._explained(through, mirrored, transmittance(interface.length, self.new.absorption), returned)
        highlight = np.maximum((liquid - before).min(-1, keepdims=True), 0)
        shading = (liquid - highlight).sum(-1, keepdims=True) / np.maximum(before.sum(-1, keepdims=True), _LEAST_LIGHT)
        kept = 1 - (1 - _KEPT_SEEN_THROUGH) * passed.mean(-1, keepdims=True)
        dyed = highlight + after * np.clip(shading, *_SHADING) ** kept
        return np.where(cover > _LEAST_OPACITY, (1 - cover) * background + cover * dyed, light).astype(np.float32)

    def _explained(self, through: Image, mirrored: Image, passed: Image, returned: NDArray[np.float64]) -> Image:
        """Light [H, W, 3] of liquid that lets `passed` of the background through and returns `returned` of its own."""
        body = through * passed + returned.astype(np.float32) * (1 - passed)
        return np.asarray((1 - mirrored) * body + mirrored * np.float32(self.filmed.mirrored), np.float32)

    def particles(self) -> Particles | None:
        """Those of the model."""
        return self._reconstruction.particles()

    def surface(self, time: float) -> SignedDistance | None:
        """That of the model."""
        return self._reconstruction.surface(time)

    def empty_view(self, camera: Camera) -> Image | None:
        """That of the model: what lies behind the liquid stays."""
        return self._reconstruction.empty_view(camera)

    def velocity(self, time: float) -> VelocityField | None:
        """That of the model."""
        return self._reconstruction.velocity(time)

    def save(self, directory: Path) -> None:
        """There is nothing to save: a dye is a few numbers."""
        raise SplashbenchError("a restyled model is not saved; save its pictures")


def _completed(interface: Interface, alpha: Image, voxel: float) -> Interface:
    """`interface` with the nearest ray's surface where there is liquid and no ray meets it."""
    seen = interface.seen
    lacking = (alpha > _LEAST_OPACITY) & ~seen
    if not lacking.any() or not seen.any():
        return interface
    nearest = distance_transform_edt(~seen, return_distances=False, return_indices=True)
    rows, columns = nearest[0][lacking], nearest[1][lacking]
    depth, normal, length = (field.copy() for field in (interface.depth, interface.normal, interface.length))
    for field in (depth, normal):
        field[lacking] = field[rows, columns]
    length[lacking] = voxel
    return Interface(depth, normal, length)


def metres_per_unit(reconstruction: Reconstruction, filmed: FilmedDye) -> float:
    """The scene's scale; where it has none, one by which the longest ways in the liquid are 25 mm."""
    return reconstruction.metres_per_unit or REFERENCE_METRES / filmed.longest


def restyled(
    reconstruction: Reconstruction, dye: Dye, density: float = 1.0, light: float = 1.0, filmed: FilmedDye | None = None
) -> Reconstruction:
    """`reconstruction` with its liquid dyed by `dye` (`splashbench.dyes.dye_named`), to be rendered as any other.

    Args:
        density: concentration as a multiple of the dye's own; inf makes it opaque.
        light: how bright white is where the liquid is, as linear light in [0, 1] or a little more.
        filmed: the dye that was filmed, where it is known already.

    Raises SplashbenchError for a method without a surface or a background, and ValueError for a density below 0.
    """
    if not density >= 0 or not 0 < light < np.inf:
        raise ValueError(f"density {density:g} must be 0 or more and light {light:g} above 0")
    if np.isinf(density) and not dye.albedo.any():
        raise SplashbenchError(
            "a dye whose thick layers return no light, such as clear, cannot be opaque; give a density"
        )
    if filmed is None:
        filmed = filmed_dye(reconstruction)
    else:
        require_optics(reconstruction)
    # Not inf: of a way of 0 it would absorb what is no number.
    strength = min(density, _OPAQUE) * metres_per_unit(reconstruction, filmed)
    new = Dye(dye.albedo, dye.absorption * np.float32(strength))
    return reconstruction.shown_by(Restyled(reconstruction, filmed, new, light))
