"""A scene as its own footage says that it was recorded: with other clocks, cameras, exposures and masks than told."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from splashbench.background.clean_plate import CleanPlate, make_clean_plates
from splashbench.scene import Camera
from splashbench.scene.scene import TrainingScene

from .cameras import FittedCameras, corrections, fit_cameras
from .clocks import Offset, clock_offsets, droplets_of
from .exposure import Response, responses
from .features import find_tracks
from .outlines import Outlines, examined
from .stance import Knock, find_knock
from .thickness import Thickness, rough_offsets
from .unmasked import hardly_masked, outlines_by_change, unconfirmed

Plates = Mapping[str, CleanPlate]
_Values = TypeVar("_Values", np.uint8, np.bool_)
# Turns, moves and the like below are not worth a word, in pixels of an image of 240.
_WORTH_A_WORD = 0.1


@dataclass(frozen=True)
class SelfCalibration:
    """What was found to be other than told; empty where nothing was.

    offsets: of clocks. seconds_per_step: of a timestep. knocks: cameras that moved. cameras: as fitted, or None where
    they are right. responses: of cameras that see light otherwise than most. outlines: of cameras whose masks are not
    what their photographs show. noisy: levels of noise of those that were not asked for that; nothing that is other.
    """

    offsets: Mapping[str, Offset] = field(default_factory=dict)
    seconds_per_step: float = 1.0
    knocks: Mapping[str, Knock] = field(default_factory=dict)
    cameras: FittedCameras | None = None
    responses: Mapping[str, Response] = field(default_factory=dict)
    outlines: Mapping[str, Outlines] = field(default_factory=dict)
    noisy: Mapping[str, float] = field(default_factory=dict)

    def __bool__(self) -> bool:
        return bool(self.offsets or self.knocks or self.cameras or self.responses or self.outlines)

    def lines(self, told: Mapping[str, Camera]) -> list[str]:
        """What was found, one line each, in words and units to act on. told: the cameras as they were told."""
        found = []
        for name, offset in self.offsets.items():
            milliseconds = 1000 * self.seconds_per_step * offset.timesteps
            when = "later" if milliseconds > 0 else "earlier"
            found.append(f"camera {name} takes its photographs {abs(milliseconds):.1f} ms {when} than told")
        for name, knock in self.knocks.items():
            turned = f"turned by {knock.degrees:.2f} deg"
            found.append(f"camera {name} was knocked before timestep {knock.frame}, and {turned}")
        if self.cameras is not None:
            found += _about_cameras(self.cameras, told)
        for name, response in self.responses.items():
            stops = float(np.mean(response.stops))
            told_of = [f"{stops:+.2f} EV"]
            if np.abs(response.stops - stops).max() > 0.02:
                red, blue = response.stops[0] - response.stops[1], response.stops[2] - response.stops[1]
                told_of.append(f"red {red:+.2f} EV, blue {blue:+.2f} EV")
            if response.contrast != 1.0:
                told_of.append(f"contrast to the power of {response.contrast:.2f}")
            found.append(f"camera {name} sees light otherwise than most: {', '.join(told_of)}")
        for name, outline in self.outlines.items():
            found.append(f"camera {name}: {outline.line}")
        for name, levels in self.noisy.items():
            found.append(
                f"camera {name}: photographs have {levels:.0f} levels of noise, too much to hold masks against them"
            )
        return found

    def scene(self, scene: TrainingScene) -> TrainingScene:
        """`scene` as it was recorded; itself where it is as told."""
        return CalibratedScene(scene, self) if self else scene


def _about_cameras(fitted: FittedCameras, told: Mapping[str, Camera]) -> list[str]:
    lines = [
        f"points that cameras show in common were off by {fitted.before:.2f} px in the middle, and are by "
        f"{fitted.after:.2f} with cameras that are {', '.join(fitted.kinds)}"
    ]
    for name, change in corrections(fitted, told).items():
        focal = told[name].K[0, 0]
        scale = max(told[name].width, told[name].height) / 240
        words = []
        if np.radians(change.turned) * focal > _WORTH_A_WORD * scale:
            words.append(f"turned by {change.turned:.2f} deg")
        if change.moved > 1e-6:
            words.append(f"{change.moved:.3g} scene units away")
        if abs(change.longer) * max(told[name].width, told[name].height) / 2 > _WORTH_A_WORD * scale:
            words.append(f"focal length {100 * change.longer:+.1f} %")
        if change.shifted > _WORTH_A_WORD * scale:
            words.append(f"principal point {change.shifted:.1f} px away")
        if words:
            lines.append(f"camera {name} is not as told: {', '.join(words)}")
    if fitted.distortion:
        lines.append(f"lens distortion is left in the photographs: k1 = {fitted.distortion:.4f}")
    return lines


class CalibratedScene(TrainingScene):
    """A scene as its own footage says that it was recorded. Photographs are straightened and evenly exposed, cameras
    and `camera_times` are those found; test cameras stay as told."""

    def __init__(self, scene: TrainingScene, found: SelfCalibration) -> None:
        super().__init__(scene._scene)
        self.found = found
        self._told = scene
        if found.cameras is not None:
            self.cameras = dict(found.cameras.cameras)
        step = found.seconds_per_step
        self.camera_times = {
            name: times + step * found.offsets[name].timesteps if name in found.offsets else times
            for name, times in scene.camera_times.items()
        }
        self._places = self._straight() if found.cameras is not None and found.cameras.distortion else {}
        #: tells this scene from the one it was made of
        self.variation = hashlib.sha256("\n".join(map(repr, self._parts())).encode()).hexdigest()

    def _parts(self) -> list[object]:
        cameras = [(name, camera.K.tolist(), camera.w2c.tolist()) for name, camera in self.cameras.items()]
        times = [(name, list(values)) for name, values in self.camera_times.items()]
        light = [(name, light.stops.tolist(), light.contrast) for name, light in self.found.responses.items()]
        knocks = [(name, knock.frame, knock.rotation.tolist()) for name, knock in self.found.knocks.items()]
        masks = [(name, outline.masks.digest) for name, outline in self.found.outlines.items()]
        return [cameras, times, light, knocks, self.found.cameras and self.found.cameras.distortion, masks]

    def _straight(self) -> dict[str, tuple[NDArray[np.float32], NDArray[np.float32]]]:
        """Where each pixel of a straight photograph is in the distorted one."""
        assert self.found.cameras is not None
        bend = np.array([self.found.cameras.distortion, 0, 0, 0])
        return {
            name: cv2.initUndistortRectifyMap(
                _from_first_pixel(camera.K), bend, np.eye(3), _from_first_pixel(camera.K),
                (camera.width, camera.height), cv2.CV_32FC1,
            )
            for name, camera in self.cameras.items()
        }  # fmt: skip

    def _placed(self, camera: str, t: int, values: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """`values` [H, W] or [H, W, 3] where they would be had the camera not been knocked, and had a straight lens."""
        border = cv2.BORDER_REPLICATE if values.ndim == 3 else cv2.BORDER_CONSTANT
        smooth = cv2.INTER_CUBIC if values.ndim == 3 else cv2.INTER_LINEAR
        knock = self.found.knocks.get(camera)
        if knock is not None and t >= knock.frame:
            K = _from_first_pixel(self._told.cameras[camera].K)
            back = K @ knock.rotation.T @ np.linalg.inv(K)
            values = np.asarray(cv2.warpPerspective(values, back, values.shape[1::-1], flags=smooth, borderMode=border))
        if camera in self._places:
            values = np.asarray(cv2.remap(values, *self._places[camera], interpolation=smooth, borderMode=border))
        return values

    def image(self, camera: str, t: int) -> NDArray[np.uint8]:
        """sRGB uint8 [H, W, 3] of a training camera at timestep `t`."""
        image = self._placed(camera, t, self._told.image(camera, t))
        response = self.found.responses.get(camera)
        return image if response is None else response.undone(image)

    def mask(self, camera: str, t: int) -> NDArray[np.bool_]:
        """Liquid mask [H, W] of a training camera at timestep `t`."""
        outline = self.found.outlines.get(camera)
        if outline is not None and t in outline.masks:
            return outline.masks[t]
        return self._placed_mask(camera, t, self._told.mask(camera, t))

    def container_mask(self, camera: str) -> NDArray[np.bool_] | None:
        """Container mask [H, W] of a training camera, or None."""
        mask = self._told.container_mask(camera)
        return None if mask is None else self._placed_mask(camera, 0, mask)

    def _placed_mask(self, camera: str, t: int, mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
        knock = self.found.knocks.get(camera)
        if camera not in self._places and (knock is None or t < knock.frame):
            return mask
        return self._placed(camera, t, np.where(mask, 255, 0).astype(np.uint8)) > 127


def _from_first_pixel(K: NDArray[np.float64]) -> NDArray[np.float64]:
    """Intrinsics that count pixels from the middle of the first one, as OpenCV does."""
    moved = K.copy()
    moved[:2, 2] -= 0.5
    return moved


def self_calibration(
    scene: TrainingScene,
    plates: Callable[[], Plates] | None = None,
    told: Callable[[str], None] = lambda what: None,
) -> SelfCalibration:
    """What the footage of `scene` says of its cameras and clocks where it is other than told.

    plates: gives the clean plates of the training views, where somebody has them. told: is given what is looked for.
    """
    if len(scene.train) < 2:
        return SelfCalibration()
    step = float(np.median(np.diff(scene.times))) if scene.n_frames > 1 else 1.0
    found = SelfCalibration(seconds_per_step=step)
    unmasked = hardly_masked(scene)
    if unmasked:
        # First of all: whatever else is looked for leaves out the liquid.
        told("looking for liquid that no mask shows")
        found = replace(found, outlines=outlines_by_change(scene, unconfirmed(scene)))
    told("looking for cameras that moved")
    masked = found.scene(scene)
    knocks = {name: knock for name in scene.train if (knock := find_knock(masked, name)) is not None}
    found = replace(found, knocks=knocks)
    told("comparing what cameras show in common")
    steady = found.scene(scene)
    shown = plates() if plates is not None and steady is scene else make_clean_plates(steady)
    shown = {name: plate.without_beside() for name, plate in shown.items()}
    tracks = find_tracks(shown, scene.cameras)
    right_ones = fit_cameras(tracks, scene.cameras, scene.initial_points, lambda given: find_tracks(shown, given))
    found = replace(found, cameras=right_ones)
    light = {name: response for name, response in responses(tracks, shown).items() if not response.is_standard}
    found = replace(found, responses=light)
    told("comparing masks with photographs")
    # Photographs that are moved or straightened are blurred by that, and droplets of few pixels look other than masks.
    bent = found.cameras is not None and found.cameras.distortion != 0
    sharp = [] if bent else [name for name in scene.train if name not in {*knocks, *found.outlines}]
    by_change = found.outlines
    if unmasked and (bent or knocks):
        # As photographs are now. One of a camera that was knocked told nothing before.
        moved = replace(found, outlines={}).scene(scene)
        by_change = outlines_by_change(moved, unconfirmed(moved))
    right = replace(found, outlines=by_change).scene(scene)
    held = examined(right, sharp)
    if 2 * len({*by_change, *held.outlines, *held.untrusted}) >= len(scene.train):
        # Of masks that show but the core of the liquid it is not told by these what they lack.
        left = [name for name in sharp if name not in {*held.outlines, *held.noisy}]
        by_change = {**by_change, **outlines_by_change(right, left)}
    found = replace(found, outlines={**by_change, **held.outlines}, noisy=held.noisy)
    told("comparing clocks")
    right = found.scene(scene)
    own_times = any(not np.array_equal(times, scene.times) for times in scene.camera_times.values())
    if scene.n_frames >= 3 and not own_times:
        drops = {
            name: droplets_of((right.mask(name, t) for t in range(scene.n_frames)), right.cameras[name])
            for name in scene.train
        }
        roughly = rough_offsets(
            {
                name: Thickness.of((right.mask(name, t) for t in range(scene.n_frames)), right.cameras[name])
                for name in scene.train
            }
        )
        found = replace(found, offsets=clock_offsets(drops, right.cameras, _down(right), roughly))
    return found


def _down(scene: TrainingScene) -> NDArray[np.float64]:
    """The direction of gravity: as the scene has it, or else down in the images, on average."""
    down = scene.gravity
    if down is None:
        down = np.mean([camera.w2c[1, :3] for camera in scene.cameras.values()], axis=0)
    down = np.asarray(down, dtype=np.float64)
    return np.asarray(down / max(float(np.linalg.norm(down)), 1e-12))
