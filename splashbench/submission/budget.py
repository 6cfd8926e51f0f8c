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

    def exceeded(self, seconds: float | None, storage_bytes: int | None, memory_bytes: int | None) -> list[str]:
        """A line for each limit that a run of these costs went over by more than methods may; None: not measured."""
        used = {
            "seconds": (seconds, 1.0, "s"),
            "storage_bytes": (storage_bytes, 1e6, "MB of storage"),
            "memory_bytes": (memory_bytes, 1e6, "MB of memory"),
        }
        return [
            f"a budget of {limit / unit:.3g} {name} could not be kept: {found / unit:.3g}"
            for key, limit in self.limits.items()
            for found, unit, name in [used[key]]
            if found is not None and found > (1 + TOLERATED) * limit
        ]

    @property
    def limits(self) -> dict[str, float]:
        """Those that are given, by name."""
        return self.model_dump(exclude_none=True)
