"""Wrong times: clocks that are apart, shutters that roll, frames that are lost.

What a camera shows at another time is what was recorded nearest to it. A scene that has frames between its timesteps
(`Recording.finest`) shows milliseconds, one without shows whole timesteps. What would change nothing is refused.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from splashbench.errors import SplashbenchError

from .images import to_linear, to_srgb
from .recording import Dice, Recording, Step


def _timesteps(step: Step, recording: Recording, milliseconds: float, least: float = 0.5) -> float:
    """`milliseconds` in timesteps; what is less than `least` frames would change nothing.

    Raises SplashbenchError where it is less.
    """
    apart = milliseconds / 1000 / recording.seconds
    if milliseconds > 0 and apart < least * recording.finest:
        between = 1000 * recording.finest * recording.seconds
        raise SplashbenchError(
            f"{step.named()} {milliseconds:.3g} ms: frames were recorded {between:.3g} ms apart, and less than "
            f"{least * between:.3g} ms changes nothing; give a scene with frames between its timesteps (--every)"
        )
    return apart


def _shifted(recording: Recording, shifts: Mapping[str, float]) -> Recording:
    return recording.retimed(lambda name, t: t + shifts.get(name, 0.0))


class ClockOffset(Step):
    """The clock of one camera is off by `amount` milliseconds."""

    kind: Literal["clock_offset"] = "clock_offset"
    amount: float = Field(ge=0, le=10_000)
    unit: ClassVar[str] = "ms"
    remedy: ClassVar[str] = (
        "Clap, or use a timecode; `splashbench prepare` aligns by sound. More droplets in view let the offset be found."
    )
    ladder: ClassVar[tuple[float, ...]] = (8, 16, 33, 66, 100)

    def applied(self, recording: Recording, dice: Dice) -> Recording:
        rng = dice.of("camera")
        chosen, sign = str(rng.choice(recording.views)), rng.choice([-1.0, 1.0])
        return _shifted(recording, {chosen: sign * _timesteps(self, recording, self.amount)})


class ClockOffsets(Step):
    """The clocks of all cameras are off, by `amount` milliseconds (root mean square)."""

    kind: Literal["clock_offsets"] = "clock_offsets"
    amount: float = Field(ge=0, le=10_000)
    unit: ClassVar[str] = "ms"
    remedy: ClassVar[str] = "Clap, or use a timecode, and check every camera by the sound."
    ladder: ClassVar[tuple[float, ...]] = (8, 16, 33, 66, 100)

    def applied(self, recording: Recording, dice: Dice) -> Recording:
        apart = _timesteps(self, recording, self.amount)
        return _shifted(recording, {n: apart * v for n, v in dice.spread(recording.views, "offsets").items()})


class ClockDrift(Step):
    """The clock of one camera runs fast or slow by `amount` parts per million, and is right in the first frame."""

    kind: Literal["clock_drift"] = "clock_drift"
    amount: float = Field(ge=0, le=500_000)
    unit: ClassVar[str] = "ppm"
    remedy: ClassVar[str] = "Sync at the end of a recording, too, or keep it short."
    ladder: ClassVar[tuple[float, ...]] = (5_000, 10_000, 20_000, 50_000, 100_000)

    def applied(self, recording: Recording, dice: Dice) -> Recording:
        rng = dice.of("camera")
        chosen, sign = str(rng.choice(recording.views)), rng.choice([-1.0, 1.0])
        _timesteps(self, recording, 1000 * self.amount / 1e6 * recording.seconds * (recording.n_frames - 1))
        rate = 1 + sign * self.amount / 1e6
        return recording.retimed(lambda name, t: t * rate if name == chosen else t)


class RollingShutter(Step):
    """Rows are read one after the other, the last `amount` milliseconds after the first, in all cameras."""

    kind: Literal["rolling_shutter"] = "rolling_shutter"
    amount: float = Field(ge=0, le=1000)
    unit: ClassVar[str] = "ms a frame"
    remedy: ClassVar[str] = "Use a global shutter, or the fastest readout: lower resolution, higher frame rate."
    ladder: ClassVar[tuple[float, ...]] = (9, 12, 17, 25, 34)

    def applied(self, recording: Recording, dice: Dice) -> Recording:
        apart = _timesteps(self, recording, self.amount, least=1.01)
        within = recording.retimed(lambda name, t: t)

        def rows(frame: Callable[[str, float], Any], name: str, t: float) -> Any:
            height = recording.cameras[name].height
            # The middle row is on time.
            times = t + apart * ((np.arange(height) + 0.5) / height - 0.5)
            steps = np.rint(times / recording.finest).astype(int)
            shown = frame(name, t).copy()
            for step in np.unique(steps):
                shown[steps == step] = frame(name, step * recording.finest)[steps == step]
            return shown

        return replace(
            recording,
            image=lambda name, t: rows(within.image, name, t),
            mask=lambda name, t: rows(within.mask, name, t),
        )


class DroppedFrames(Step):
    """One camera loses `amount` of its frames without a word: what follows comes that much too early."""

    kind: Literal["dropped_frames"] = "dropped_frames"
    amount: float = Field(ge=0, lt=1)
    unit: ClassVar[str] = "share of frames"
    remedy: ClassVar[str] = "Use faster cards, and check that the frames' times are even."
    ladder: ClassVar[tuple[float, ...]] = (0.02, 0.05, 0.1, 0.2, 0.4)

    def applied(self, recording: Recording, dice: Dice) -> Recording:
        chosen, lost = _stumbles(self.amount, recording, dice)
        return recording.retimed(lambda name, t: t + lost[int(t)] if name == chosen else t)


class DoubledFrames(Step):
    """One camera doubles `amount` of its frames without a word: what follows comes that much too late."""

    kind: Literal["doubled_frames"] = "doubled_frames"
    amount: float = Field(ge=0, lt=1)
    unit: ClassVar[str] = "share of frames"
    remedy: ClassVar[str] = "Record at a constant frame rate, and check that no two frames are alike."
    ladder: ClassVar[tuple[float, ...]] = (0.02, 0.05, 0.1, 0.2, 0.4)

    def applied(self, recording: Recording, dice: Dice) -> Recording:
        chosen, doubled = _stumbles(self.amount, recording, dice)
        return recording.retimed(lambda name, t: t - doubled[int(t)] if name == chosen else t)


def _stumbles(share: float, recording: Recording, dice: Dice) -> tuple[str, NDArray[np.int64]]:
    """One camera, and how many of its frames stumbled up to each timestep; one at least where `share` is above 0."""
    rng = dice.of("camera")
    chosen = str(rng.choice(recording.views))
    count = max(1, round(share * recording.n_frames)) if share > 0 else 0
    where = rng.choice(np.arange(1, recording.n_frames), size=min(count, recording.n_frames - 1), replace=False)
    return chosen, np.cumsum(np.isin(np.arange(recording.n_frames), where))


class MotionBlur(Step):
    """Shutters are open for `amount` milliseconds: a photograph is the mean of what was recorded in that time."""

    kind: Literal["motion_blur"] = "motion_blur"
    amount: float = Field(ge=0, le=1000)
    unit: ClassVar[str] = "ms"
    remedy: ClassVar[str] = "Shorten the shutter, and add light."
    ladder: ClassVar[tuple[float, ...]] = (17, 25, 34, 50, 67)

    def applied(self, recording: Recording, dice: Dice) -> Recording:
        half = 0.5 * _timesteps(self, recording, self.amount, least=2.0)
        reach = int(np.floor(half / recording.finest + 1e-9))
        within = recording.retimed(lambda name, t: t)

        def image(name: str, t: float) -> NDArray[np.uint8]:
            frames = [to_linear(within.image(name, t + k * recording.finest)) for k in range(-reach, reach + 1)]
            return to_srgb(np.mean(frames, axis=0))

        return replace(recording, image=image)
