"""Two small scenes in the layout of the released ones, unpacked as `splashbench download scenes` does."""

from __future__ import annotations

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
def real(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the scenes; read-only."""
    place = tmp_path_factory.mktemp("real")
    write_release(place / "given.zip", imitations(NAMES))
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SPLASHBENCH_CACHE", str(place / "cache"))
        download_scenes(place / "scenes", NAMES, ("full", "crop"), place / "given.zip", tell=lambda line: None)
    return place / "scenes"


@pytest.fixture(scope="session")
def made(real: Path, _short_reference: None, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A benchmark that was run whole; read-only."""
    out = tmp_path_factory.mktemp("made") / "out"
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SPLASHBENCH_CACHE", str(out.parent / "cache"))
        assert main(["benchmark", "run", str(out), "--scenes", str(real), "--methods", GREY, "nearest_camera"]) == 0
    return out
