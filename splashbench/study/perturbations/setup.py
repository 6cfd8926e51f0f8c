"""What a scene lacks or states wrongly besides photographs and cameras: views, gravity, the container's place."""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar, Literal

import numpy as np
from pydantic import Field

from splashbench.errors import SplashbenchError

from .cameras import direction, turn
from .recording import Dice, Recording, Step

# Of cameras without which nothing has a depth.
_FEWEST = 2


class MissingCameras(Step):
    """`amount` cameras recorded nothing; fewer are always among more. Two have to be left."""

    kind: Literal["missing_cameras"] = "missing_cameras"
    amount: int = Field(ge=0, le=1000)
    unit: ClassVar[str] = "cameras"
    remedy: ClassVar[str] = "Check cards and batteries of all cameras before the pour, and place one more than needed."
    ladder: ClassVar[tuple[float, ...]] = (1, 2, 3, 4, 5)

    def applied(self, recording: Recording, dice: Dice) -> Recording:
        left = len(recording.views) - self.amount
        if left < _FEWEST:
            raise SplashbenchError(
                f"missing_cameras takes {self.amount} of {len(recording.views)} training views, and {_FEWEST} have to "
                "be left"
            )
        gone = dice.of("cameras").permutation(list(recording.views))[: self.amount].tolist()
        return replace(recording, cameras={n: camera for n, camera in recording.cameras.items() if n not in gone})


class GravityError(Step):
    """Gravity is stated `amount` degrees beside where things fall."""

    kind: Literal["gravity_error"] = "gravity_error"
    amount: float = Field(ge=0, le=180)
    unit: ClassVar[str] = "deg"
    remedy: ClassVar[str] = "Take gravity from the table's plane or a spirit level, or leave it out of scene.json."
    ladder: ClassVar[tuple[float, ...]] = (1, 2, 5, 10, 20)

    def applied(self, recording: Recording, dice: Dice) -> Recording:
        if recording.gravity is None:
            raise SplashbenchError("gravity_error needs a scene that states gravity")
        given = np.asarray(recording.gravity, dtype=np.float64)
        beside = np.cross(given, direction(dice.of("axis")))
        beside /= np.linalg.norm(beside)
        angle = np.radians(self.amount)
        stated = np.cos(angle) * given + np.sin(angle) * beside
        return replace(recording, gravity=stated / np.linalg.norm(stated))


class ContainerMisplaced(Step):
    """The container's mesh is stated `amount` millimetres from where it stood, and turned by as many tenths of a
    degree about its origin."""

    kind: Literal["container_misplaced"] = "container_misplaced"
    amount: float = Field(ge=0, le=1000)
    unit: ClassVar[str] = "mm"
    remedy: ClassVar[str] = (
        "Place it by its masks with `splashbench scene place-container`, or leave it out of scene.json."
    )
    ladder: ClassVar[tuple[float, ...]] = (1, 2, 5, 10, 20)

    def applied(self, recording: Recording, dice: Dice) -> Recording:
        scale, pose = recording.metres_per_unit, recording.container_pose
        if pose is None:
            raise SplashbenchError("container_misplaced needs a scene that has the container's mesh in place")
        if scale is None:
            raise SplashbenchError("container_misplaced is in millimetres, and the scene's metric scale is not known")
        moved = np.array(pose, dtype=np.float64)
        moved[:3, :3] = turn(dice.of("axis"), self.amount / 10) @ moved[:3, :3]
        moved[:3, 3] += self.amount / 1000 / scale * direction(dice.of("direction"))
        return replace(recording, container_pose=moved)
