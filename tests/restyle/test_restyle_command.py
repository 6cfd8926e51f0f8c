"""`splashbench restyle`, from a fit to pictures, buffers and numbers."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from splashbench.cli.main import main
from splashbench.files import read_image
from splashbench.harness.runner import run_method
from splashbench.scene import Scene

FEW = {"hull_cells": 48, "transport_cells": 32, "control_cells": 8, "iterations": 60}


@pytest.fixture(scope="module")
def fit(balls_directory: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("fit") / "splashsplat"
    run_method("splashsplat", balls_directory, out, preset="quick", overrides=FEW, timing_frames=0)
    return out


def test_pictures_buffers_and_numbers(
    fit: Path, balls: Scene, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    import OpenEXR

    out = tmp_path / "green"
    assert main(["restyle", str(fit), str(out), "--dye", "green", "--density", "opaque", "--exr", "--json"]) == 0
    printed = capsys.readouterr()
    told = json.loads(printed.out)
    assert "filmed" in printed.err
    assert told["frames"] == balls.n_frames * len(balls.test)
    facts = json.loads((out / "dye.json").read_text())
    assert facts["filmed"] == told["filmed"]
    assert facts["density"] == "opaque"
    name, t = balls.test[0], 3
    mask = balls.mask(name, t)
    picture = read_image(out / name / f"{t:06d}.png")
    assert picture[mask].mean(axis=0).argmax() == 1
    with OpenEXR.File(str(out / "exr" / name / f"{t:06d}.exr"), separate_channels=True) as file:
        channels = {key: channel.pixels for key, channel in file.channels().items()}
    assert set(channels) >= {"R", "G", "B", "A", "depth.Z", "length.Z", "normal.X", "normal.Y", "normal.Z"}
    assert channels["A"].shape == mask.shape
    met = np.isfinite(channels["depth.Z"]) & mask
    assert met.sum() > 0.5 * mask.sum()
    assert (channels["length.Z"][met] > 0).all()
    size = np.sqrt(sum(channels[f"normal.{axis}"] ** 2 for axis in "XYZ"))
    np.testing.assert_allclose(size[met], 1, atol=1e-3)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--dye", "purple"], "there is no dye"),
        (["--dye", "green", "--view", "42"], "there is no camera"),
        (["--dye", "green", "--scene", "nowhere"], "nowhere"),
    ],
)
def test_wrong_input_is_one_line(
    fit: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], options: list[str], said: str
) -> None:
    assert main(["restyle", str(fit), str(tmp_path / "out"), *options]) == 1
    printed = capsys.readouterr().err.strip()
    assert said in printed
    assert "\n" not in printed
    assert not (tmp_path / "out").exists()


def test_what_is_there_stays(fit: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    place = tmp_path / "mine"
    place.mkdir()
    (place / "thesis.txt").write_text("years")
    assert main(["restyle", str(fit), str(place), "--dye", "green"]) == 1
    assert main(["restyle", str(fit), str(place), "--dye", "green", "--replace"]) == 1
    (place / "dye.json").write_text('{"recipe": "of wool"}')
    assert main(["restyle", str(fit), str(place), "--dye", "green", "--replace"]) == 1
    assert "dye.json is of something else" in capsys.readouterr().err
    assert (place / "thesis.txt").read_text() == "years"
    assert main(["restyle", str(fit), str(fit / "dyed"), "--dye", "green"]) == 1
    capsys.readouterr()


@pytest.mark.parametrize("density", ["-1", "nan", "inf", "much"])
def test_an_impossible_density_is_told(density: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["restyle", "a", "b", "--dye", "green", "--density", density])
    assert "is no density" in capsys.readouterr().err


def test_a_video_of_the_dyed_liquid(fit: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["video", str(fit), str(tmp_path / "dyed"), "--dye", "green", "--density", "opaque", "--no-caption"]
    assert main([*words, "--timesteps", "--beside", str(fit)]) == 0
    picture = read_image(sorted((tmp_path / "dyed").glob("*.png"))[3])
    dyed, filmed = picture[:, : picture.shape[1] // 2].astype(int), picture[:, picture.shape[1] // 2 :].astype(int)
    changed = np.abs(dyed - filmed).max(axis=-1) > 60
    assert changed.sum() > 50
    assert dyed[changed].mean(axis=0).argmax() == 1
    assert main(["video", str(fit), str(tmp_path / "more"), "--density", "2"]) == 1
    assert "--density has no effect without --dye" in capsys.readouterr().err
