"""Settings that had another name before: who gives the old one is told the new one, in one line."""

from pathlib import Path

import pytest

from splashbench.cli.main import main
from splashbench.errors import SplashbenchError
from splashbench.harness.discovery import load_method

RENAMED = [
    ("splashsplat", "distance", "signed_distance", "carve"),
    ("splashsplat", "detect_failures", "detect_failed_masks", "false"),
    ("splashsplat", "shared_cells", "feature_cells", "[4]"),
    ("splashsplat", "learning_rate_shared", "learning_rate_cells", "0.01"),
    ("splashsplat", "withheld_share", "validation_share", "0"),
    ("splashsplat", "colour_weight", "color_weight", "1"),
    ("deformable_3dgs", "most", "max_gaussians", "700"),
    ("spacetime_gaussians", "most", "max_gaussians", "700"),
    ("spacetime_gaussians_lite", "most", "max_gaussians", "700"),
    ("scaffold_4d", "most", "max_anchors", "700"),
    ("scaffold_gs", "anchors", "max_anchors", "700"),
    ("nothing", "anchors", "max_anchors", "700"),
]


@pytest.mark.parametrize(("method", "old", "new", "value"), RENAMED)
def test_an_old_name_is_told_the_new_one(method: str, old: str, new: str, value: str) -> None:
    config = load_method(method).Config
    with pytest.raises(SplashbenchError) as raised:
        config.preset("quick", {old: value})
    assert str(raised.value) == f"setting {old} is now called {new}; give {new}={value}"


def test_the_command_says_so_in_one_line(balls_directory: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    out = tmp_path / "out"
    command = ["run", "deformable_3dgs", str(balls_directory), str(out), "--preset", "quick", "--set", "most=700"]
    assert main(command) == 1
    assert capsys.readouterr().err.strip() == "error: setting most is now called max_gaussians; give max_gaussians=700"
    assert not out.exists()


@pytest.mark.parametrize("method", sorted({row[0] for row in RENAMED}))
def test_presets_use_names_that_exist(method: str) -> None:
    config = load_method(method).Config
    for preset, values in config.presets.items():
        assert set(values) <= set(config.model_fields)
        config.preset(preset)
    assert set(config.renamed.values()) <= set(config.model_fields)
    assert not set(config.renamed) & set(config.model_fields)
