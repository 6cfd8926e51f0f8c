"""What can be wrong with a recording, in physical units: masks, photographs, cameras, clocks, setup (docs/study.md)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, get_args

from pydantic import Field

from .cameras import (
    CameraMoved,
    FocalError,
    LensDistortion,
    PoseRotation,
    PoseTranslation,
    PrincipalPointError,
    TightFraming,
)
from .clocks import ClockDrift, ClockOffset, ClockOffsets, DoubledFrames, DroppedFrames, MotionBlur, RollingShutter
from .images import (
    Compression,
    Defocus,
    Exposure,
    Gamma,
    Haze,
    MovingShadow,
    Passer,
    SensorNoise,
    WhiteBalance,
)
from .masks import (
    EmptyMasks,
    ErodedMasks,
    FlickeringMasks,
    GrownMasks,
    HoledMasks,
    MaskShare,
    MissingParts,
    WrongMasks,
    with_shares,
)
from .recording import Dice, Recording, Step
from .setup import ContainerMisplaced, GravityError, MissingCameras
from .timesteps import FewerTimesteps, UnevenTimesteps

Perturbation = Annotated[
    EmptyMasks
    | MissingParts
    | ErodedMasks
    | GrownMasks
    | HoledMasks
    | FlickeringMasks
    | WrongMasks
    | ClockOffset
    | ClockOffsets
    | ClockDrift
    | RollingShutter
    | DroppedFrames
    | DoubledFrames
    | MotionBlur
    | FewerTimesteps
    | UnevenTimesteps
    | PoseRotation
    | PoseTranslation
    | FocalError
    | PrincipalPointError
    | LensDistortion
    | CameraMoved
    | TightFraming
    | MissingCameras
    | GravityError
    | ContainerMisplaced
    | Exposure
    | WhiteBalance
    | Gamma
    | SensorNoise
    | Defocus
    | Compression
    | Haze
    | MovingShadow
    | Passer,
    Field(discriminator="kind"),
]
#: All kinds, in the order in which tables have them.
KINDS: tuple[type[Step], ...] = get_args(get_args(Perturbation)[0])


def perturbed(recording: Recording, steps: Sequence[Step], dice: Dice) -> Recording:
    """`recording` with all of `steps`, one after the other; what takes a share of masks comes first, drawn together.

    Raises SplashbenchError for a step that the recording cannot have, such as an offset between two of its frames.
    """
    shares = [step for step in steps if isinstance(step, MaskShare)]
    if shares:
        recording = with_shares(recording, shares, dice)
    for number, step in enumerate(steps):
        if not isinstance(step, MaskShare):
            recording = step.applied(recording, Dice(dice.seed, f"{dice.name}/{number}"))
    return recording


__all__ = ["KINDS", "Dice", "Perturbation", "Recording", "Step", "perturbed"]
