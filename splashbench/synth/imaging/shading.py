"""Light: one soft key light, a sky brighter above than below, and for wet surfaces their mirror image of both.

Everything is linear light on float32 arrays [R, 3]; a surface of albedo 1 in full light comes out near 1.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from splashbench.synth.imaging.geometry import BOWL_RIM_HEIGHT, BOWL_RIM_RADIUS

Vectors = NDArray[np.float32]

TO_LIGHT = np.array([0.42, 0.80, 0.43], np.float32)
TO_LIGHT /= np.linalg.norm(TO_LIGHT)
KEY = np.float32(0.62)
SKY = np.float32(0.62)
LIQUID_ALBEDO = np.array([0.035, 0.13, 0.50], np.float32)
_REFLECTANCE_HEAD_ON = 0.02  # of water in air
_GLOSS = 90.0
#: Of the dyed liquid where it is clear, per metre of red, green and blue light.
LIQUID_ABSORPTION = np.array([70.0, 30.0, 9.0], np.float32)


def ambient(normal: Vectors) -> NDArray[np.float32]:
    """Light [R, 1] from all around on a surface of this normal; from below it is half as strong as from above."""
    return SKY * (0.75 + 0.25 * normal[:, 1:2])


def key_light(normal: Vectors) -> NDArray[np.float32]:
    """Unoccluded light [R, 1] from the key light."""
    return KEY * np.maximum(normal @ TO_LIGHT, 0)[:, None]


def matte(albedo: Vectors, normal: Vectors) -> tuple[Vectors, Vectors]:
    """A dull surface in full light and in the key light's shadow: two arrays [R, 3]."""
    shaded = albedo * ambient(normal)
    return shaded + albedo * key_light(normal), shaded


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
) -> Vectors:
    """Dyed liquid seen along unit `view` directions: diffuse dye, Fresnel mirror of the room, and a highlight.

    `lit` [R]: reached by the key light; `openness` [R]: share of the sky that is not blocked; `behind`: what a clear
    liquid mixes in (Beer-Lambert, without refraction), None for an opaque one. Reflectance after Schlick 1994.
    """
    towards = np.where(np.einsum("ij,ij->i", normal, view)[:, None] > 0, -normal, normal)
    facing = np.clip(-np.einsum("ij,ij->i", towards, view), 0, 1)
    mirror = view + 2 * facing[:, None] * towards
    fresnel = _REFLECTANCE_HEAD_ON + (1 - _REFLECTANCE_HEAD_ON) * (1 - facing) ** 5
    diffuse = ambient(towards) * openness[:, None] + key_light(towards) * lit[:, None]
    half = TO_LIGHT - view
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    highlight = np.maximum(np.einsum("ij,ij->i", towards, half), 0) ** _GLOSS * 0.9 * lit
    body = LIQUID_ALBEDO * diffuse
    if behind is not None:
        clear = np.exp(-LIQUID_ABSORPTION * behind.thickness[:, None])
        body = clear * (1 - fresnel)[:, None] * behind.color + (1 - clear) * body
    color = body + (fresnel * openness)[:, None] * surroundings(mirror)
    return (color + highlight[:, None]).astype(np.float32)


def surroundings(direction: Vectors) -> Vectors:
    """What a mirror sees along `direction` [R, 3]: walls, a pale ceiling, and a window beside the key light."""
    up = np.clip(direction[:, 1:2], 0, 1)
    wall = np.array([0.34, 0.35, 0.33], np.float32) + 0.5 * up
    window = np.clip((direction @ np.array([-0.50, 0.62, 0.60], np.float32) - 0.80) / 0.06, 0, 1)[:, None]
    return (wall + 1.1 * window).astype(np.float32)


def bowl_openness(points: Vectors) -> NDArray[np.float32]:
    """Share [R] of the sky that liquid at `points` sees: all of it above the bowl's rim, less the deeper inside."""
    depth = np.clip((BOWL_RIM_HEIGHT - points[:, 1]) / BOWL_RIM_HEIGHT, 0, 1)
    inside = np.hypot(points[:, 0], points[:, 2]) < BOWL_RIM_RADIUS
    return np.where(inside, 1 - 0.45 * depth, 1).astype(np.float32)
