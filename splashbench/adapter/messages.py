"""What the harness and its child process say to each other: a request file in, JSON lines and a result file out."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import BaseModel, ConfigDict

from splashbench.submission import Status

#: Exit code of a child that could not write; the last line of its log says which file.
DISK_FULL_EXIT = 28


class Request(BaseModel):
    """What a child process is to do. `phase` fit: scene -> model. `phase` render: model -> test views."""

    model_config = ConfigDict(extra="forbid")
    phase: Literal["fit", "render"]
    #: The process that waits for the child, and without which the child must not go on.
    harness: int
    method: str
    scene: str
    preset: str
    overrides: dict[str, Any]
    seed: int
    device: str
    budget_seconds: float | None
    scratch: str
    model: str
    output: str
    result: str
    progress: str
    timing_frames: int
    exr: bool
    cache: str | None = None


class Outcome(BaseModel):
    """How a phase ended, as the harness's own code in the child process saw it."""

    model_config = ConfigDict(extra="forbid")
    status: Status = Status.OK
    reason: str = ""
    seconds: float | None = None
    reused: dict[str, float] = {}
    stages: dict[str, float] = {}
    render_fps: float | None = None
    timed_frames: int | None = None
    primitives_per_frame: float | None = None
    peak_device_memory_bytes: int | None = None
    settings: dict[str, Any] = {}
    renderer: list[str] = []
