"""How long a fit may take, by those that came before on this machine. Where none was like it, nothing is said.

The user's cache folder keeps the times of the latest fits: of the same method, settings and device, on a scene with
about as many pixels, the next one takes about as long. No formula guesses the rest.
"""

from __future__ import annotations

import hashlib
import json
import statistics
from collections.abc import Sequence
from pathlib import Path

from pydantic import BaseModel, ConfigDict, Field

from splashbench.cache import cache_folder
from splashbench.errors import SplashbenchError, one_line
from splashbench.files import read_model, write_model
from splashbench.scene import Scene
from splashbench.submission import Identity

_FILE = "fit_times.json"
_KEPT = 500
#: Scenes whose pixels differ by no more than this factor count as of one size.
_ALIKE = 1.25
#: Fits of less are not worth a line.
TOLD_SECONDS = 10.0


class _Fit(BaseModel):
    model_config = ConfigDict(extra="forbid")
    key: str
    scene: str
    pixels: int = Field(gt=0)
    seconds: float = Field(ge=0, le=1e9, allow_inf_nan=False)


class _Fits(BaseModel):
    model_config = ConfigDict(extra="forbid")
    fits: list[_Fit] = []


def estimate(identity: Identity, scene: Scene, kept: Sequence[int]) -> str:
    """A line on how long the fit that `identity` names may take; "" where no earlier fit tells, or it is over at once.

    kept: the timesteps that the method sees.
    """
    key, pixels = _key(identity), _pixels(scene, kept)
    like = [fit for fit in _read().fits if fit.key == key and 1 / _ALIKE <= fit.pixels / pixels <= _ALIKE]
    if not like:
        return ""
    own = [fit for fit in like if fit.scene == scene.name] or like
    seconds = statistics.median(fit.seconds for fit in own)
    if seconds < TOLD_SECONDS:
        return ""
    runs = "one fit" if len(own) == 1 else f"{len(own)} fits"
    of = "this scene" if own[0].scene == scene.name else f"a scene of this size ({one_line(own[0].scene)[:60]})"
    return f"about {duration(seconds)} to fit, as {runs} with these settings of {of} took on this machine"


def note(identity: Identity, scene: Scene, kept: Sequence[int], seconds: float) -> None:
    """Keep that the fit took `seconds`. A cache folder that cannot be written keeps nothing."""
    fit = _Fit(key=_key(identity), scene=scene.name, pixels=_pixels(scene, kept), seconds=seconds)
    try:
        write_model(cache_folder() / _FILE, _Fits(fits=[*_read().fits, fit][-_KEPT:]))
    except (SplashbenchError, OSError):
        return


def _read() -> _Fits:
    try:
        path: Path = cache_folder() / _FILE
        return read_model(path, _Fits) if path.is_file() else _Fits()
    except (SplashbenchError, OSError):
        return _Fits()


def _key(identity: Identity) -> str:
    """Names what the time of a fit depends on besides the scene's size."""
    budget = identity.budget.model_dump(mode="json") if identity.budget else None
    machine = [identity.hardware.get(name) for name in ("cpu", "cores", "gpu")]
    facts = [identity.method, identity.method_version, identity.settings, identity.device, budget, machine]
    return hashlib.sha256(json.dumps(facts, sort_keys=True, default=str).encode()).hexdigest()[:16]


def _pixels(scene: Scene, kept: Sequence[int]) -> int:
    return len(kept) * sum(scene.cameras[name].width * scene.cameras[name].height for name in scene.train)


def duration(seconds: float) -> str:
    """ "40 s", "8 min" or "2.5 h"."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"
