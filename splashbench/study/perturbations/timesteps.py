"""Timesteps that nobody recorded: what a method shows of them is scored, as with `run --withhold`.

Unlike a camera's lost frames (clocks.py) these are missing for all cameras, and the method is told when the others
were recorded.
"""

from __future__ import annotations

from typing import ClassVar, Literal

from pydantic import Field

from .recording import Dice, Recording, Step


class FewerTimesteps(Step):
    """Only each `amount`-th timestep was recorded."""

    kind: Literal["fewer_timesteps"] = "fewer_timesteps"
    amount: int = Field(ge=0, le=999)
    unit: ClassVar[str] = "timesteps apart"
    remedy: ClassVar[str] = "Record at a higher frame rate: a splash moves by its own width within a frame."
    ladder: ClassVar[tuple[float, ...]] = (2, 3, 4, 6, 8)
    none: ClassVar[float] = 1.0

    @property
    def withheld(self) -> str | None:
        return f"keep_1_of_{self.amount}" if self.amount > 1 else None

    def applied(self, recording: Recording, dice: Dice) -> Recording:
        return recording


class UnevenTimesteps(Step):
    """`amount` of the timesteps were not recorded, here and there."""

    kind: Literal["uneven_timesteps"] = "uneven_timesteps"
    amount: float = Field(ge=0, le=0.99)
    unit: ClassVar[str] = "share of timesteps"
    remedy: ClassVar[str] = "Use faster cards, and look for gaps in the frames' times."
    ladder: ClassVar[tuple[float, ...]] = (0.1, 0.2, 0.35, 0.5, 0.7)

    @property
    def withheld(self) -> str | None:
        percent = round(100 * self.amount)
        return f"drop_{percent}_percent" if percent > 0 else None

    def applied(self, recording: Recording, dice: Dice) -> Recording:
        return recording
