"""What a method sees of the training views, as something that can be made worse (docs/study.md)."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, get_args

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict

from splashbench.scene import Camera

#: uint8 [H, W, 3], sRGB, and bool [H, W]: of a camera, at a time in timesteps, which lies between two where a recording
#: has frames there.
ImageAt = Callable[[str, float], NDArray[np.uint8]]
MaskAt = Callable[[str, float], NDArray[np.bool_]]


@dataclass(frozen=True)
class Recording:
    """The training views.

    cameras: of each view, as a method is told. n_frames: timesteps. seconds: that one lasts. finest: timesteps between
    recorded frames: 1, or less where the recording has frames between. metres_per_unit: where it is known.
    container_mask: bool [H, W] of a camera, or None. gravity: unit vector [3], where it is stated. container_pose: 4x4,
    mesh to scene, where there is a mesh in its place.
    """

    cameras: Mapping[str, Camera]
    n_frames: int
    seconds: float
    image: ImageAt
    mask: MaskAt
    finest: float = 1.0
    metres_per_unit: float | None = None
    container_mask: Callable[[str], NDArray[np.bool_] | None] = lambda name: None
    gravity: NDArray[np.float64] | None = None
    container_pose: NDArray[np.float64] | None = None

    @property
    def views(self) -> tuple[str, ...]:
        return tuple(self.cameras)

    def with_cameras(self, change: Callable[[Camera], Camera]) -> Recording:
        """The same pictures, and other cameras than those that took them."""
        return replace(self, cameras={name: change(camera) for name, camera in self.cameras.items()})

    def with_images(self, change: Callable[[str, float, NDArray[np.uint8]], NDArray[np.uint8]]) -> Recording:
        """change: is given camera, time and image."""
        return replace(self, image=lambda name, t: change(name, t, self.image(name, t)))

    def with_masks(self, change: Callable[[str, float, NDArray[np.bool_]], NDArray[np.bool_]]) -> Recording:
        """change: is given camera, time and mask."""
        return replace(self, mask=lambda name, t: change(name, t, self.mask(name, t)))

    def retimed(self, shown: Callable[[str, float], float]) -> Recording:
        """shown: the time, in timesteps, of what a camera shows at a timestep; the first and the last frame last."""
        last = max(self.n_frames - self.finest, self.n_frames - 1)

        def at(name: str, t: float) -> float:
            # What was recorded nearest to it.
            return float(np.clip(np.rint(shown(name, t) / self.finest) * self.finest, 0.0, last))

        return replace(
            self,
            image=lambda name, t: self.image(name, at(name, t)),
            mask=lambda name, t: self.mask(name, at(name, t)),
        )


@dataclass(frozen=True)
class Dice:
    """Random numbers by name, so that one draw does not depend on how many came before it."""

    seed: int
    name: str

    def all(self) -> np.random.Generator:
        """The generator for all that is drawn at once."""
        return np.random.default_rng([self.seed, *hashlib.sha256(self.name.encode()).digest()[:8]])

    def of(self, *what: object) -> np.random.Generator:
        """The generator for `what`: a camera, a frame, a purpose."""
        text = "/".join(map(str, (self.name, *what)))
        return np.random.default_rng([self.seed, *hashlib.sha256(text.encode()).digest()[:8]])

    def spread(self, views: Sequence[str], what: str) -> dict[str, float]:
        """A number of each of `views` for `what`, with a mean of 0 and a root mean square of 1."""
        values = self.of(what).normal(size=len(views))
        values -= values.mean()
        values /= max(float(np.sqrt((values**2).mean())), 1e-9)
        return dict(zip(views, values.tolist()))


class Step(BaseModel):
    """One thing that is wrong with a recording.

    unit: of its amount. ladder: five amounts, from what is hardly seen to what nobody would accept. measured: the name
    of the field that holds the amount. none: the amount of a recording as it is. remedy: what to do about it in one's
    own recording, a sentence.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)
    unit: ClassVar[str]
    remedy: ClassVar[str]
    ladder: ClassVar[tuple[float, ...]]
    measured: ClassVar[str] = "amount"
    none: ClassVar[float] = 0.0

    @classmethod
    def named(cls) -> str:
        """Its kind, as specs have it."""
        (name,) = get_args(cls.model_fields["kind"].annotation)
        return str(name)

    @classmethod
    def at(cls, amount: float) -> Step:
        """The step of this kind with that amount."""
        return cls.model_validate({"kind": cls.named(), cls.measured: amount})

    @property
    def withheld(self) -> str | None:
        """The timesteps that it leaves out, as submission/withheld.py says it; None for none."""
        return None

    def applied(self, recording: Recording, dice: Dice) -> Recording:
        """`recording` as it is with that; nothing is read before it is asked for."""
        raise NotImplementedError
