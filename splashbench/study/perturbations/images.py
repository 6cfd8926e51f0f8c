"""Worse photographs: light, sensor, lens, codec, and what else is in the room.

Light is changed where it adds up, before the sRGB curve (IEC 61966-2-1).
"""

from __future__ import annotations

import io
from functools import lru_cache
from typing import ClassVar, Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from .recording import Dice, Recording, Step

_Image = NDArray[np.uint8]
# A shadow's width, as a share of the image's, and how often it crosses in a recording.
_SHADOW_WIDTH, _CROSSINGS = 0.25, 1.5
# Of a person: width by height, and the grey of the clothes.
_SLIM, _CLOTHES = 0.3, np.array([52, 56, 64], dtype=np.uint8)
# x264's macroblock tree gives other bits now and then, even on one thread.
_REPEATABLE = {"preset": "medium", "threads": "1", "x264-params": "mbtree=0"}
# Of haze, what one sees through none of it: a bright grey, linear.
_AIRLIGHT = 0.6


def to_linear(image: _Image) -> NDArray[np.float32]:
    """sRGB uint8 to linear light in [0, 1], float32."""
    curve = np.arange(256, dtype=np.float64) / 255
    curve = np.where(curve <= 0.04045, curve / 12.92, ((curve + 0.055) / 1.055) ** 2.4)
    return curve.astype(np.float32)[image]


def to_srgb(linear: NDArray[np.floating]) -> _Image:
    """Linear light to sRGB uint8, clipped."""
    light = np.clip(linear, 0, 1)
    curve = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    return np.rint(255 * curve).astype(np.uint8)


class Exposure(Step):
    """Cameras expose apart by `amount` stops (root mean square)."""

    kind: Literal["exposure"] = "exposure"
    amount: float = Field(ge=0, le=4)
    unit: ClassVar[str] = "EV"
    remedy: ClassVar[str] = "Lock exposure in all cameras."
    ladder: ClassVar[tuple[float, ...]] = (0.1, 0.25, 0.5, 1.0, 1.5)

    def applied(self, recording: Recording, dice: Dice) -> Recording:
        stops = dice.spread(recording.views, "exposure")
        return recording.with_images(
            lambda name, t, image: to_srgb(to_linear(image) * np.float32(2.0 ** (self.amount * stops[name])))
        )


class WhiteBalance(Step):
    """Red rises and blue falls by `amount` stops (root mean square over cameras), or the other way round."""

    kind: Literal["white_balance"] = "white_balance"
    amount: float = Field(ge=0, le=2)
    unit: ClassVar[str] = "EV"
    remedy: ClassVar[str] = "Lock white balance in all cameras."
    ladder: ClassVar[tuple[float, ...]] = (0.05, 0.1, 0.2, 0.4, 0.8)

    def applied(self, recording: Recording, dice: Dice) -> Recording:
        warmth = dice.spread(recording.views, "white balance")

        def change(name: str, t: float, image: _Image) -> _Image:
            gain = 2.0 ** (self.amount * warmth[name])
            return to_srgb(to_linear(image) * np.array([gain, 1, 1 / gain], np.float32))

        return recording.with_images(change)


class Gamma(Step):
    """Contrast curves of cameras are apart: values in [0, 1] to the power of 2^(`amount` x a number of the camera)."""

    kind: Literal["gamma"] = "gamma"
    amount: float = Field(ge=0, le=2)
    unit: ClassVar[str] = "octaves of the exponent"
    remedy: ClassVar[str] = "Use the same picture profile in all cameras."
    ladder: ClassVar[tuple[float, ...]] = (0.05, 0.1, 0.2, 0.4, 0.8)

    def applied(self, recording: Recording, dice: Dice) -> Recording:
        exponents = {n: 2.0 ** (self.amount * v) for n, v in dice.spread(recording.views, "gamma").items()}
        values = np.arange(256) / 255
        tables = {name: np.rint(255 * values**power).astype(np.uint8) for name, power in exponents.items()}
        return recording.with_images(lambda name, t, image: tables[name][image])


class SensorNoise(Step):
    """Gaussian noise of `amount` levels on every channel of every photograph."""

    kind: Literal["sensor_noise"] = "sensor_noise"
    amount: float = Field(ge=0, le=255)
    unit: ClassVar[str] = "levels of 255"
    remedy: ClassVar[str] = "Add light, and lower the gain."
    ladder: ClassVar[tuple[float, ...]] = (2, 5, 10, 20, 40)

    def applied(self, recording: Recording, dice: Dice) -> Recording:
        def change(name: str, t: float, image: _Image) -> _Image:
            noise = dice.of("noise", name, t).normal(scale=self.amount, size=image.shape)
            return np.clip(np.rint(image + noise), 0, 255).astype(np.uint8)

        return recording.with_images(change)


class Defocus(Step):
    """One camera is out of focus: a Gaussian of `amount` pixels over its photographs."""

    kind: Literal["defocus"] = "defocus"
    amount: float = Field(ge=0, le=100)
    unit: ClassVar[str] = "px"
    remedy: ClassVar[str] = "Focus by hand on the liquid, and close the aperture."
    ladder: ClassVar[tuple[float, ...]] = (0.5, 1, 2, 4, 8)

    def applied(self, recording: Recording, dice: Dice) -> Recording:
        chosen = str(dice.of("camera").choice(recording.views))

        def change(name: str, t: float, image: _Image) -> _Image:
            if name != chosen or self.amount == 0:
                return image
            blurred = cv2.GaussianBlur(to_linear(image), (0, 0), self.amount, borderType=cv2.BORDER_REPLICATE)
            return to_srgb(blurred)

        return recording.with_images(change)


class Haze(Step):
    """Steam or a misted lens before every camera: `amount` of the light is an even grey."""

    kind: Literal["haze"] = "haze"
    amount: float = Field(ge=0, le=1)
    unit: ClassVar[str] = "share of the light"
    remedy: ClassVar[str] = "Wipe lenses, and keep steam out of the line of sight."
    ladder: ClassVar[tuple[float, ...]] = (0.05, 0.1, 0.2, 0.4, 0.6)

    def applied(self, recording: Recording, dice: Dice) -> Recording:
        grey = np.float32(self.amount * _AIRLIGHT)
        return recording.with_images(
            lambda name, t, image: to_srgb(to_linear(image) * np.float32(1 - self.amount) + grey)
        )


class MovingShadow(Step):
    """A soft shadow that takes `amount` of the light wanders through every view, from another side in each."""

    kind: Literal["moving_shadow"] = "moving_shadow"
    amount: float = Field(ge=0, le=1)
    unit: ClassVar[str] = "share of the light"
    remedy: ClassVar[str] = "Keep people away from the lamps."
    ladder: ClassVar[tuple[float, ...]] = (0.1, 0.2, 0.4, 0.6, 0.8)

    def applied(self, recording: Recording, dice: Dice) -> Recording:
        def change(name: str, t: float, image: _Image) -> _Image:
            rng = dice.of("shadow", name)
            angle, phase = rng.uniform(0, 2 * np.pi), rng.uniform()
            height, width = image.shape[:2]
            x, y = (np.arange(width) + 0.5) / width - 0.5, (np.arange(height) + 0.5) / height - 0.5
            along = np.cos(angle) * x + np.sin(angle) * y[:, None]
            at = 2 * ((phase + _CROSSINGS * t / recording.n_frames) % 1.0) - 1
            shade = 1 - self.amount * np.exp(-(((along - at) / _SHADOW_WIDTH) ** 2))
            return to_srgb(to_linear(image) * shade[..., None].astype(np.float32))

        return recording.with_images(change)


class Passer(Step):
    """Someone walks past behind the liquid, `amount` of the image tall, through every view, in some sooner."""

    kind: Literal["person_walking_past"] = "person_walking_past"
    amount: float = Field(ge=0, le=1)
    unit: ClassVar[str] = "share of the image's height"
    remedy: ClassVar[str] = "Keep people out of all views, or hang a backdrop."
    ladder: ClassVar[tuple[float, ...]] = (0.2, 0.4, 0.6, 0.8, 1.0)

    def applied(self, recording: Recording, dice: Dice) -> Recording:
        starts = {name: dice.of("person", name).uniform(-0.3, 0.3) for name in recording.views}

        def change(name: str, t: float, image: _Image) -> _Image:
            if self.amount == 0:
                return image
            height, width = image.shape[:2]
            tall = self.amount * height
            at = (starts[name] + 1.4 * t / recording.n_frames - 0.2) * width
            x = (np.arange(width) + 0.5 - at) / (0.5 * _SLIM * tall)
            y = (np.arange(height) + 0.5 - (height - 0.5 * tall)) / (0.5 * tall)
            person = (x**2 + y[:, None] ** 2 < 1) & ~recording.mask(name, t)
            return np.where(person[..., None], _CLOTHES, image)

        return recording.with_images(change)


class Compression(Step):
    """Every view's recording passes through H.264 at a constant rate factor of `amount`, all frames in one film."""

    kind: Literal["compression"] = "compression"
    amount: float = Field(ge=0, le=51)
    unit: ClassVar[str] = "CRF"
    remedy: ClassVar[str] = "Record at the highest bit rate, and work from the originals."
    none: ClassVar[float] = 18.0  # what passes for no loss
    ladder: ClassVar[tuple[float, ...]] = (28, 33, 38, 43, 48)

    def applied(self, recording: Recording, dice: Dice) -> Recording:
        times = np.arange(recording.n_frames)

        @lru_cache(maxsize=1)
        def film(name: str) -> list[_Image]:
            return _through_h264([recording.image(name, float(t)) for t in times], self.amount)

        # What lies between timesteps is not in the film.
        return recording.with_images(lambda name, t, image: film(name)[round(t)] if t == round(t) else image)


def _through_h264(images: list[_Image], rate_factor: float) -> list[_Image]:
    """The images [H, W, 3] after encoding as one film and decoding it. Odd sides are padded for it."""
    import av

    height, width = images[0].shape[:2]
    buffer = io.BytesIO()
    with av.open(buffer, "w", format="mp4") as film:
        stream = film.add_stream("libx264", rate=30, options={"crf": str(rate_factor)} | _REPEATABLE)
        stream.width, stream.height, stream.pix_fmt = width + width % 2, height + height % 2, "yuv420p"
        for number, image in enumerate(images):
            padded = np.pad(image, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
            frame = av.VideoFrame.from_ndarray(padded, format="rgb24")
            frame.pts = number  # without one, films of the same frames differ
            for packet in stream.encode(frame):
                film.mux(packet)
        for packet in stream.encode():
            film.mux(packet)
    buffer.seek(0)
    with av.open(buffer) as film:
        decoded = [frame.to_ndarray(format="rgb24")[:height, :width] for frame in film.decode(video=0)]
    assert len(decoded) == len(images)
    return decoded
