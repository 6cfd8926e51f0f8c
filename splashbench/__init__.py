"""splashbench: reconstruct splashing liquids from several cameras, and score reconstructions by one fixed protocol.

The stages, one noun each: Session -> Scene -> Submission -> Result -> Leaderboard (docs/ and README.md).
The names below are what the author of a method, or a reader of scenes and submissions, needs. Each is imported when it
is first asked for, so that `import splashbench` and `splashbench --help` answer at once.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from splashbench.errors import SplashbenchError
from splashbench.version import __version__

if TYPE_CHECKING:
    from splashbench.harness.contract import Fitted, Method, MethodConfig, Render, Run, Support
    from splashbench.replay import Reconstruction, load
    from splashbench.scene import (
        Camera,
        Gaussians,
        Particles,
        Scene,
        SignedDistance,
        TrainingScene,
        VelocityField,
    )
    from splashbench.submission import Submission

__all__ = [
    "Camera",
    "Fitted",
    "Gaussians",
    "Method",
    "MethodConfig",
    "Particles",
    "Reconstruction",
    "Render",
    "Run",
    "Scene",
    "SignedDistance",
    "SplashbenchError",
    "Submission",
    "Support",
    "TrainingScene",
    "VelocityField",
    "__version__",
    "load",
]

#: Module -> the names that are imported from it on demand.
_MODULES = {
    "splashbench.harness.contract": ("Fitted", "Method", "MethodConfig", "Render", "Run", "Support"),
    "splashbench.replay": ("Reconstruction", "load"),
    "splashbench.scene": (
        *("Camera", "Gaussians", "Particles", "Scene", "SignedDistance", "TrainingScene", "VelocityField"),
    ),
    "splashbench.submission": ("Submission",),
}

if not TYPE_CHECKING:  # else mypy would take any name for one of the module's

    def __getattr__(name: str) -> Any:
        for module, names in _MODULES.items():
            if name in names:
                value = getattr(import_module(module), name)
                globals()[name] = value
                return value
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
