"""A small synthetic session, made once for all tests that look at one."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from pathlib import Path

import pytest

from splashbench.synth.recording.plan import RecordingOptions

SMALL = RecordingOptions(size=(128, 72), fps=20, seed=3, duration=0.7, particle_radius=0.005)


@pytest.fixture(scope="session")
def small_session(once: Callable[[str, Callable[[Path], None]], Path]) -> Path:
    """A whole session of tiny frames and coarse liquid."""
    for module in ("pysplishsplash", "pysplashsurf", "embreex"):
        if importlib.util.find_spec(module) is None:
            pytest.skip(f"{module} is not installed (splashbench[synth])")
    from splashbench.synth.recording.session import make_session

    def make(folder: Path) -> None:
        make_session(folder / "session", SMALL)

    return once("synth_session", make) / "session"
