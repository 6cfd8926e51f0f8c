"""What a method decided by itself during a fit, and by what evidence: `decisions` of record.json.

A decision is one question (how fine the grid, how many features), what was tried for it in order, and what was bought.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

#: Decisions in a record, and rungs in a decision, at most.
MAX_DECISIONS, MAX_RUNGS = 50, 40
_Text = Annotated[str, Field(max_length=500)]
_Figure = Annotated[float, Field(ge=-1e15, le=1e15)]


class Rung(BaseModel):
    """One thing that was tried, or could have been.

    value: in words with its unit, as "16 features". quality: what `Decision.measure` names, higher is better; gain: of
    it over the rung that was held before, and its standard error. seconds, bytes: what it costs more than that rung
    (negative: saves). bought: whether it was taken.
    """

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)
    value: Annotated[str, Field(min_length=1, max_length=100)]
    bought: bool
    quality: _Figure | None = None
    gain: _Figure | None = None
    standard_error: Annotated[float, Field(ge=0, le=1e15)] | None = None
    seconds: _Figure | None = None
    bytes: _Figure | None = None
    reason: _Text = ""


class Decision(BaseModel):
    """A question that the fit answered.

    basis: what answered it. "scene" is what its cameras, times and motion let one see; "withheld" photographs of the
    training views; a stated "tolerance"; or the user's "budget". measure: what `Rung.quality` is, with its unit.
    """

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)
    name: Annotated[str, Field(min_length=1, max_length=60)]
    basis: Literal["scene", "withheld", "tolerance", "budget"]
    chosen: Annotated[str, Field(min_length=1, max_length=100)]
    because: _Text
    measure: Annotated[str, Field(max_length=100)] = ""
    rungs: list[Rung] = Field(default_factory=list, max_length=MAX_RUNGS)
