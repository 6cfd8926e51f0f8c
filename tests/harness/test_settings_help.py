"""A setting's help is what its author wrote of it, wherever that stands."""

from pathlib import Path
from typing import ClassVar

import pytest
from pydantic import Field

from splashbench.cli.main import main
from splashbench.harness.contract import Fitted, Method, MethodConfig, Run
from splashbench.harness.discovery import load_method, registered
from splashbench.harness.settings_help import settings_help
from splashbench.scene import Scene, TrainingScene


class Base(MethodConfig):
    """Settings of several.

    Attributes:
        steps: of the optimisation, one
            photograph each. width, depth: of the network.
        grow_from: share from which there is growth, every `grow_every` steps.
    """

    steps: int = 1
    width: int = 2
    depth: int = 3
    grow_from: float = 0.1
    grow_every: int = 100


class Own(Base):
    """Settings of one."""

    presets: ClassVar[dict] = {"best": {}}
    #: how much of it, in shares;
    #: 0 for none
    amount: float = 0.5
    points: int = 8  # per frame
    rate: float = Field(0.1, description="of learning")
    unsaid: int = 0
    steps: int = 4


def test_help_is_found_in_docstrings_comments_and_descriptions() -> None:
    assert settings_help(Own) == {
        "steps": "of the optimisation, one photograph each.",
        "width": "of the network.",
        "depth": "of the network.",
        "grow_from": "share from which there is growth, every `grow_every` steps.",
        "grow_every": "share from which there is growth, every `grow_every` steps.",
        "amount": "how much of it, in shares; 0 for none",
        "points": "per frame",
        "rate": "of learning",
    }


@pytest.mark.parametrize("name", list(registered()))
def test_every_setting_of_a_method_has_help(name: str) -> None:
    config = load_method(name).Config
    assert sorted(set(config.model_fields) - set(settings_help(config))) == []


def test_show_tells_presets_budgets_the_ladder_and_what_settings_are(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["methods", "show", "splashsplat"]) == 0
    out = capsys.readouterr().out
    assert "keeps to budgets: --budget-seconds, --budget-mb" in out
    assert "hull_cells: 96, 144, 208, 300, 416" in out
    assert "color_width = 32" in out
    assert "hidden units of the colour head" in out
    assert all(line.isprintable() for line in out.splitlines())
    assert main(["methods", "show", "nearest_camera"]) == 0
    assert "ladder" not in capsys.readouterr().out


class Reads(Method):
    """Notes what folder it is given."""

    id, title, Config = "reads", "reads", Own

    def fit(self, scene: TrainingScene, config: Own, run: Run) -> Fitted:
        raise NotImplementedError

    def load(self, directory: Path, scene: TrainingScene) -> Fitted:
        assert (directory / "..").is_dir()
        return directory  # type: ignore[return-value]


def test_a_model_is_loaded_from_text_too(balls: Scene) -> None:
    assert Reads().load("/tmp", balls.training()) == Path("/tmp")
    assert Reads().load(Path("/tmp"), balls.training()) == Path("/tmp")
