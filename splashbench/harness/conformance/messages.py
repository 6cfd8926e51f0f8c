"""What the conformance test and its child process say to each other: an order in, an answer out."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field

#: What a view is asked for: as in a run, between the timesteps, at another size, through a window of a view.
Kind = Literal["test", "between", "size", "window"]


class Subject(BaseModel):
    """The method under test, with what settings and limits."""

    model_config = ConfigDict(extra="forbid")
    id: str
    method: str
    preset: str
    overrides: dict[str, Any]
    device: str
    timeout_seconds: float


class Order(BaseModel):
    """What a child process is to do: fit, save and render; or load and render. Paths are absolute."""

    model_config = ConfigDict(extra="forbid")
    do: Literal["fit", "load"]
    subject: Subject
    seed: int
    view: str  # the training view that the method is given
    scene: str  # the scene that it is a view of
    model: str
    scratch: str
    answer: str
    progress: str
    touched: str


class Seen(BaseModel):
    """One view as rendered: SHA-256 of its pixels, or what is wrong with it."""

    model_config = ConfigDict(extra="forbid")
    kind: Kind
    digest: str = ""
    fault: str = ""


class Held(BaseModel):
    """Particles or signed distance: SHA-256 of their arrays, what they are, or what is wrong with them."""

    model_config = ConfigDict(extra="forbid")
    digest: str = ""
    about: str = ""
    fault: str = ""


class Said(BaseModel):
    """The progress that a fit reported."""

    model_config = ConfigDict(extra="forbid")
    reports: int = 0
    messages: int = 0
    fault: str = ""


class Answer(BaseModel):
    """How an order ended. Where `stage` is not empty, it ended there, for `reason`."""

    model_config = ConfigDict(extra="forbid")
    stage: str = ""
    reason: str = ""
    #: whether `reason` is one meant for users: of `supports`, or a SplashbenchError
    clear: bool = False
    fit_seconds: float = 0.0
    said: Said = Field(default_factory=Said)
    views: dict[str, Seen] = Field(default_factory=dict)
    #: digests of the same views rendered once more, the last one first
    again: dict[str, str] = Field(default_factory=dict)
    #: what is wrong with the content of the window, see views.window_fault
    window_fault: str = ""
    particles: Held = Field(default_factory=Held)
    geometry: Held = Field(default_factory=Held)

    @property
    def done(self) -> bool:
        """Whether everything ordered was done."""
        return not self.stage
