"""Two small scenes in the layout of the released ones, unpacked as `splashbench download scenes` does."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from splashbench.cli.main import main
from splashbench.download.scenes import download_scenes
from splashbench.synth.release import imitations, write_release

NAMES = ("bowl_001", "tank_002")
GREY = f"{Path(__file__).parents[1] / 'study' / 'study_methods.py'}:Grey"


@pytest.fixture(autouse=True)
def _own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SPLASHBENCH_CACHE", str(tmp_path / "cache"))


@pytest.fixture(scope="session")
def real(once: Callable[[str, Callable[[Path], None]], Path]) -> Path:
    """The folder of the scenes; read-only."""

    def make(place: Path) -> None:
        write_release(place / "given.zip", imitations(NAMES))
        with pytest.MonkeyPatch.context() as patch:
            patch.setenv("SPLASHBENCH_CACHE", str(place / "cache"))
            download_scenes(place / "scenes", NAMES, ("full", "crop"), place / "given.zip", tell=lambda line: None)

    return once("benchmark_scenes", make) / "scenes"


@pytest.fixture(scope="session")
def made(real: Path, _short_reference: None, once: Callable[[str, Callable[[Path], None]], Path]) -> Path:
    """A benchmark that was run whole; read-only."""

    def make(place: Path) -> None:
        words = ["benchmark", "run", str(place / "out"), "--scenes", str(real), "--methods", GREY, "nearest_camera"]
        with pytest.MonkeyPatch.context() as patch:
            patch.setenv("SPLASHBENCH_CACHE", str(place / "cache"))
            assert main(words) == 0

    return once("benchmark_made", make) / "out"
