"""Wrong calibrations: cameras that are told otherwise than they stood, and cameras that were moved."""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar, Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from splashbench.errors import SplashbenchError
from splashbench.scene import Camera

from .recording import Dice, Recording, Step


def direction(rng: np.random.Generator) -> NDArray[np.float64]:
    """A unit vector [3], evenly over all directions."""
    vector = rng.normal(size=3)
    return np.asarray(vector / np.linalg.norm(vector))


def turn(rng: np.random.Generator, degrees: float) -> NDArray[np.float64]:
    """A rotation [3, 3] by `degrees` about a random axis."""
    return np.asarray(cv2.Rodrigues(direction(rng) * np.radians(degrees))[0])


def _with_intrinsics(camera: Camera, change: NDArray[np.float64]) -> Camera:
    return replace(camera, K=camera.K + change)


class PoseRotation(Step):
    """Every camera is told turned about its own centre by `amount` degrees, each about an axis of its own."""

    kind: Literal["pose_rotation"] = "pose_rotation"
    amount: float = Field(ge=0, le=90)
    unit: ClassVar[str] = "deg"
    remedy: ClassVar[str] = (
        "Calibrate again where cameras were touched; `splashbench scene self-calibrate` tells which are turned."
    )
    ladder: ClassVar[tuple[float, ...]] = (0.1, 0.25, 0.5, 1.0, 2.0)

    def applied(self, recording: Recording, dice: Dice) -> Recording:
        def change(camera: Camera) -> Camera:
            turned = camera.w2c.copy()
            turned[:3, :3] = turn(dice.of("axis", camera.name), self.amount) @ camera.w2c[:3, :3]
            turned[:3, 3] = -turned[:3, :3] @ camera.center
            return replace(camera, w2c=turned)

        return recording.with_cameras(change)


class PoseTranslation(Step):
    """Every camera is told `amount` millimetres away from where it stood, each in a direction of its own."""

    kind: Literal["pose_translation"] = "pose_translation"
    amount: float = Field(ge=0, le=1000)
    unit: ClassVar[str] = "mm"
    remedy: ClassVar[str] = "Calibrate again where cameras were touched, with a board or COLMAP in view of all of them."
    ladder: ClassVar[tuple[float, ...]] = (1, 2, 5, 10, 20)

    def applied(self, recording: Recording, dice: Dice) -> Recording:
        scale = recording.metres_per_unit
        if scale is None:
            raise SplashbenchError("pose_translation is in millimetres, and the scene's metric scale is not known")

        def change(camera: Camera) -> Camera:
            moved = camera.w2c.copy()
            away = self.amount / 1000 / scale * direction(dice.of("direction", camera.name))
            moved[:3, 3] = -moved[:3, :3] @ (camera.center + away)
            return replace(camera, w2c=moved)

        return recording.with_cameras(change)


class FocalError(Step):
    """Focal lengths are told off by `amount` per cent (root mean square over cameras)."""

    kind: Literal["focal_error"] = "focal_error"
    amount: float = Field(ge=0, le=50)
    unit: ClassVar[str] = "%"
    remedy: ClassVar[str] = "Lock zoom and stabilisation, and calibrate with the settings of the recording."
    ladder: ClassVar[tuple[float, ...]] = (0.2, 0.5, 1, 2, 5)

    def applied(self, recording: Recording, dice: Dice) -> Recording:
        def change(camera: Camera) -> Camera:
            share = np.clip(dice.of("focal", camera.name).normal(scale=self.amount / 100), -0.9, 0.9)
            return _with_intrinsics(camera, np.diag([camera.K[0, 0], camera.K[1, 1], 0]) * share)

        return recording.with_cameras(change)


class PrincipalPointError(Step):
    """Principal points are told `amount` pixels away, each in a direction of its own."""

    kind: Literal["principal_point_error"] = "principal_point_error"
    amount: float = Field(ge=0, le=1000)
    unit: ClassVar[str] = "px"
    remedy: ClassVar[str] = "Turn electronic stabilisation off, and crop images and cameras alike."
    ladder: ClassVar[tuple[float, ...]] = (0.5, 1, 2, 4, 8)

    def applied(self, recording: Recording, dice: Dice) -> Recording:
        def change(camera: Camera) -> Camera:
            angle, away = dice.of("point", camera.name).uniform(0, 2 * np.pi), np.zeros((3, 3))
            away[:2, 2] = self.amount * np.cos(angle), self.amount * np.sin(angle)
            return _with_intrinsics(camera, away)

        return recording.with_cameras(change)


class LensDistortion(Step):
    """A barrel distortion of k1 = -`amount` (OpenCV's model) is left in photographs and masks of all views."""

    kind: Literal["lens_distortion"] = "lens_distortion"
    amount: float = Field(ge=0, le=0.3)
    unit: ClassVar[str] = "k1"
    remedy: ClassVar[str] = "Undistort photographs and masks before they become a scene, as `splashbench prepare` does."
    ladder: ClassVar[tuple[float, ...]] = (0.005, 0.01, 0.02, 0.05, 0.1)

    def applied(self, recording: Recording, dice: Dice) -> Recording:
        def place(name: str) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
            camera = recording.cameras[name]
            rows, columns = np.mgrid[: camera.height, : camera.width].astype(np.float64) + 0.5
            pixels = np.stack([columns, rows], axis=-1).reshape(-1, 1, 2)
            # Where a pixel of the distorted image comes from in the straight one.
            straight = cv2.undistortPoints(pixels, camera.K, np.array([-self.amount, 0, 0, 0]), P=camera.K)
            map_x, map_y = np.moveaxis(straight.reshape(camera.height, camera.width, 2) - 0.5, -1, 0)
            return map_x.astype(np.float32), map_y.astype(np.float32)

        return _warped(recording, {name: place(name) for name in recording.views})


class CameraMoved(Step):
    """One camera is knocked in the middle of the recording: from then on it looks `amount` degrees elsewhere."""

    kind: Literal["camera_moved"] = "camera_moved"
    amount: float = Field(ge=0, le=45)
    unit: ClassVar[str] = "deg"
    remedy: ClassVar[str] = "Weigh tripods down and use a remote; cut the recording where a camera moved."
    ladder: ClassVar[tuple[float, ...]] = (0.1, 0.25, 0.5, 1.0, 2.0)

    def applied(self, recording: Recording, dice: Dice) -> Recording:
        rng = dice.of("camera")
        chosen = str(rng.choice(recording.views))
        camera = recording.cameras[chosen]
        # About its centre, which changes a picture as a homography does, whatever is in it.
        homography = camera.K @ turn(rng, self.amount) @ np.linalg.inv(camera.K)
        rows, columns = np.mgrid[: camera.height, : camera.width] + 0.5
        seen = np.stack([columns, rows, np.ones_like(rows)], axis=-1) @ np.linalg.inv(homography).T
        place = tuple((seen[..., i] / seen[..., 2] - 0.5).astype(np.float32) for i in (0, 1))
        return _warped(recording, {chosen: (place[0], place[1])}, start=recording.n_frames / 2)


class TightFraming(Step):
    """One camera is zoomed in, and told so: `amount` of its images' width and height is cut off about the middle."""

    kind: Literal["tight_framing"] = "tight_framing"
    amount: float = Field(ge=0, le=0.9)
    unit: ClassVar[str] = "share of the image's width"
    remedy: ClassVar[str] = "Frame all the liquid in every camera, with room for what splashes out."
    ladder: ClassVar[tuple[float, ...]] = (0.2, 0.35, 0.5, 0.6, 0.7)

    def applied(self, recording: Recording, dice: Dice) -> Recording:
        chosen = str(dice.of("camera").choice(recording.views))
        camera, times = recording.cameras[chosen], 1 / (1 - self.amount)
        zoom = np.diag([times, times, 1.0])
        zoom[:2, 2] = (1 - times) / 2 * np.array([camera.width, camera.height])
        rows, columns = (
            ((np.arange(size) + 0.5 - zoom[axis, 2]) / times - 0.5).astype(np.float32)
            for axis, size in ((1, camera.height), (0, camera.width))
        )
        place_x, place_y = np.meshgrid(columns, rows)
        told = recording.with_cameras(lambda one: replace(one, K=zoom @ one.K) if one.name == chosen else one)
        return _warped(told, {chosen: (place_x, place_y)})


def _warped(
    recording: Recording,
    places: dict[str, tuple[NDArray[np.float32], NDArray[np.float32]]],
    start: float = 0.0,
) -> Recording:
    """Photographs and masks from timestep `start` on, read at `places`: columns and rows [H, W] of each view there."""

    def warp(name: str, values: NDArray[np.uint8], smooth: int) -> NDArray[np.uint8]:
        border = cv2.BORDER_REPLICATE if values.ndim == 3 else cv2.BORDER_CONSTANT
        return np.asarray(cv2.remap(values, *places[name], interpolation=smooth, borderMode=border))

    def image(name: str, t: float, values: NDArray[np.uint8]) -> NDArray[np.uint8]:
        return warp(name, values, cv2.INTER_CUBIC) if name in places and t >= start else values

    def mask(name: str, t: float, values: NDArray[np.bool_]) -> NDArray[np.bool_]:
        if name not in places or t < start:
            return values
        return warp(name, 255 * values.astype(np.uint8), cv2.INTER_LINEAR) > 127

    def container(name: str) -> NDArray[np.bool_] | None:
        values = recording.container_mask(name)
        return values if values is None else mask(name, 0.0, values)

    return replace(recording.with_images(image).with_masks(mask), container_mask=container)
