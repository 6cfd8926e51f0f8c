"""The scripts of examples/ run as they stand, and do what their page says."""

from __future__ import annotations

import json
import runpy
from pathlib import Path
from typing import Any

import imageio.v3 as imageio
import numpy as np
import pytest

ROOT = Path(__file__).parents[2]
EXAMPLES = ROOT / "examples"
_LENGTH = 60


def example(name: str) -> Any:
    """The function `main` of an example."""
    return runpy.run_path(str(EXAMPLES / f"{name}.py"))["main"]


def test_each_example_is_short_explained_and_on_its_pages() -> None:
    pages = [(ROOT / page).read_text(encoding="utf-8") for page in ("examples/README.md", "docs/examples.md")]
    names = sorted(path.name for path in EXAMPLES.glob("*.py"))
    assert len(names) == 5
    for name in names:
        text = (EXAMPLES / name).read_text(encoding="utf-8")
        assert text.startswith('"""')
        assert len(text.splitlines()) < _LENGTH, name
        assert all(name in page for page in pages), name


def test_a_look_at_a_scene(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    picture = imageio.imread(example("look_at_a_scene")(tmp_path))
    assert picture.std() > 10
    assert "test views 6, 7" in capsys.readouterr().out


def test_a_flight_around(tmp_path: Path) -> None:
    film = imageio.imread(example("fly_around")(tmp_path, frames=6, size=(96, 64)), plugin="pyav")
    assert film.shape == (6, 64, 96, 3)
    # Camera and liquid move: no two neighbouring pictures are the same.
    assert np.abs(np.diff(film.astype(float), axis=0)).mean(axis=(1, 2, 3)).min() > 0.5


def test_a_score_for_another_code(tmp_path: Path) -> None:
    result = example("score_other_code")(tmp_path)
    # Noise of 0.05 is 26.0 dB; clipped at black and white, it is a little less.
    assert result.value("psnr") == pytest.approx(26.0, abs=0.5)
    assert result.value("miou") == 1.0


def test_a_method_of_your_own(tmp_path: Path) -> None:
    result = example("add_a_method")(tmp_path)
    assert result.status == "ok"
    assert result.value("miou") > 0.5


@pytest.mark.slow
def test_two_methods_compared(tmp_path: Path) -> None:
    files = example("compare_methods")(tmp_path, methods=("nearest_camera",))
    board = next(path for path in files if path.suffix == ".csv").read_text(encoding="utf-8")
    assert "nearest_camera" in board
    assert "nothing" in board


@pytest.mark.slow
def test_the_notebook_runs_and_shows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    plt.close("all")

    notebook = json.loads((EXAMPLES / "look_at_a_splash.ipynb").read_text(encoding="utf-8"))
    assert notebook["nbformat"] == 4
    cells = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    assert all(not cell["outputs"] and cell["execution_count"] is None for cell in cells)  # none is committed
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    for cell in cells:
        exec(compile("".join(cell["source"]), "look_at_a_splash.ipynb", "exec"), names)
    assert "splashsplat (quick)" in repr(names["splash"])
    assert names["volume"] > 0
    assert names["interface"].seen.any()
    figures = [plt.figure(number) for number in plt.get_fignums()]
    assert len(figures) == 3
    for figure in figures:
        figure.canvas.draw()
        assert np.asarray(figure.canvas.buffer_rgba()).std() > 10
    plt.close("all")
