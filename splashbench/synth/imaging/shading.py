"""Light: one soft key light, a sky brighter above than below, and for wet or glazed surfaces a mirror image of both.

Everything is linear light on float32 arrays [R, 3]; a surface of albedo 1 in full light comes out near 1.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from splashbench.dyes import DYES, Dye
from splashbench.synth.imaging.geometry import BowlShape

Vectors = NDArray[np.float32]
Color = tuple[float, float, float]

_REFLECTANCE_HEAD_ON = 0.02  # of water in air
_GLOSS = 90.0


@dataclass(frozen=True, eq=False)
class Light:
    """A room's light: the unit direction `towards` the key light, how strong it and the sky are, and a window.

    `key` and `sky` are one number, or one of red, green and blue each. `window` [3] points to what a mirror shows.
    """

    towards: NDArray[np.float32]
    key: NDArray[np.float32]
    sky: NDArray[np.float32]
    window: NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class PouredDye(Dye):
    """A liquid's colour: its `albedo` where it is opaque, its `absorption` where it is clear.

    Attributes:
        tints_shadow: its shadow is the light that comes through it; without, no light does.
    """

    tints_shadow: bool = False


def light_from(towards: Color, key: Color | float, sky: Color | float, window: Color) -> Light:
    """A light from plain numbers."""
    direction = np.array(towards, np.float32)
    direction /= np.linalg.norm(direction)
    return Light(direction, np.array(key, np.float32), np.array(sky, np.float32), np.array(window, np.float32))


DAYLIGHT = light_from((0.42, 0.80, 0.43), 0.62, 0.62, (-0.50, 0.62, 0.60))
BLUE = PouredDye(DYES["blue"].albedo, DYES["blue"].absorption)


def ambient(normal: Vectors, light: Light) -> NDArray[np.float32]:
    """Light [R, 1 or 3] from all around on a surface of this normal; half as strong from below as from above."""
    return light.sky * (0.75 + 0.25 * normal[:, 1:2])


def key_light(normal: Vectors, light: Light) -> NDArray[np.float32]:
    """Unoccluded light [R, 1 or 3] from the key light."""
    return light.key * np.maximum(normal @ light.towards, 0)[:, None]


def matte(albedo: Vectors, normal: Vectors, light: Light = DAYLIGHT) -> tuple[Vectors, Vectors]:
    """A dull surface in full light and in the key light's shadow: two arrays [R, 3]."""
    shaded = albedo * ambient(normal, light)
    return shaded + albedo * key_light(normal, light), shaded


@dataclass(frozen=True)
class Glaze:
    """A smooth clear coat on a matte body: `reflectance` head-on, and how sharp its `highlight` is (an exponent)."""

    reflectance: float = 0.05
    highlight: float = 260.0

    def share(self, normal: Vectors, view: Vectors) -> NDArray[np.float32]:
        """Share [R, 1] of the light from the mirror's direction that the coat returns (Schlick 1994)."""
        facing = np.clip(-np.einsum("ij,ij->i", normal, view), 0, 1)[:, None]
        return (self.reflectance + (1 - self.reflectance) * (1 - facing) ** 5).astype(np.float32)

    def glint(self, normal: Vectors, view: Vectors, light: Light) -> NDArray[np.float32]:
        """The key light's mirror image [R, 1] where nothing blocks it (Blinn and Phong)."""
        return (1.4 * _towards_half(normal, view, light) ** self.highlight)[:, None].astype(np.float32)


def mirrored(normal: Vectors, view: Vectors) -> Vectors:
    """Unit directions [R, 3] that a mirror of this normal shows along unit `view` directions."""
    return (view - 2 * np.einsum("ij,ij->i", normal, view)[:, None] * normal).astype(np.float32)


def _towards_half(normal: Vectors, view: Vectors, light: Light) -> NDArray[np.float32]:
    half = light.towards - view
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    return np.maximum(np.einsum("ij,ij->i", normal, half), 0)


@dataclass(frozen=True, eq=False)
class Behind:
    """What clear liquid lets through: the light `color` [R, 3] behind it, and the way `thickness` [R], metres."""

    color: Vectors
    thickness: NDArray[np.float32]


def wet(
    normal: Vectors,
    view: Vectors,
    lit: NDArray[np.bool_],
    openness: NDArray[np.float32],
    behind: Behind | None = None,
    dye: PouredDye = BLUE,
    light: Light = DAYLIGHT,
) -> Vectors:
    """Dyed liquid seen along unit `view` directions: diffuse dye, Fresnel mirror of the room, and a highlight.

    `lit` [R]: reached by the key light; `openness` [R]: share of the sky that is not blocked; `behind`: what a clear
    liquid mixes in (Beer-Lambert, without refraction), None for an opaque one. Reflectance after Schlick 1994.
    """
    towards = np.where(np.einsum("ij,ij->i", normal, view)[:, None] > 0, -normal, normal)
    facing = np.clip(-np.einsum("ij,ij->i", towards, view), 0, 1)
    mirror = view + 2 * facing[:, None] * towards
    fresnel = _REFLECTANCE_HEAD_ON + (1 - _REFLECTANCE_HEAD_ON) * (1 - facing) ** 5
    diffuse = ambient(towards, light) * openness[:, None] + key_light(towards, light) * lit[:, None]
    highlight = _towards_half(towards, view, light) ** _GLOSS * 0.9 * lit
    body = dye.albedo * diffuse
    if behind is not None:
        clear = np.exp(-dye.absorption * behind.thickness[:, None])
        body = clear * (1 - fresnel)[:, None] * behind.color + (1 - clear) * body
    color = body + (fresnel * openness)[:, None] * surroundings(mirror, light)
    return (color + highlight[:, None]).astype(np.float32)


def surroundings(direction: Vectors, light: Light = DAYLIGHT) -> Vectors:
    """What a mirror sees along `direction` [R, 3]: walls, a pale ceiling, and a window beside the key light."""
    up = np.clip(direction[:, 1:2], 0, 1)
    wall = np.array([0.34, 0.35, 0.33], np.float32) + 0.5 * up
    window = np.clip((direction @ light.window - 0.80) / 0.06, 0, 1)[:, None]
    return (wall + 1.1 * window).astype(np.float32)


def bowl_openness(points: Vectors, bowl: BowlShape) -> NDArray[np.float32]:
    """Share [R] of the sky that liquid at `points` sees: all of it above the bowl's rim, less the deeper inside."""
    depth = np.clip((bowl.rim_height - points[:, 1]) / bowl.rim_height, 0, 1)
    inside = np.hypot(points[:, 0], points[:, 2]) < bowl.rim_radius
    return np.where(inside, 1 - 0.45 * depth, 1).astype(np.float32)
