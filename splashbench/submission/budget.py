"""What a fit may cost, as its user says: seconds, bytes of the stored model, bytes of memory."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field

#: Share of a limit by which a method may go over it.
TOLERATED = 0.05


class Budget(BaseModel):
    """Limits of a fit; None is no limit. A method that takes a budget keeps to it within 5 %, and may use less.

    seconds: of the fit. storage_bytes: of the stored model, its static part included. memory_bytes: the most that the
    process has in memory at once.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)
    seconds: float | None = Field(default=None, gt=0, le=1e9)
    storage_bytes: int | None = Field(default=None, gt=0, le=10**15)
    memory_bytes: int | None = Field(default=None, gt=0, le=10**15)

    @property
    def limits(self) -> dict[str, float]:
        """Those that are given, by name."""
        return self.model_dump(exclude_none=True)
