"""Words and clicks for SAM3 as session.toml states them."""

from __future__ import annotations

from typing import Any

import pytest
from pydantic import ValidationError

from splashbench.prepare.session_tables import Masks


def test_session_toml_describes_the_prompts() -> None:
    masks = Masks.model_validate(
        {
            "provider": "sam3",
            "checkpoint": "../models/sam3",
            "text": "red water",
            "points": {"3": [{"frame": 812, "x": 1204, "y": 733}, {"frame": 812, "x": 1, "y": 2, "liquid": False}]},
        }
    )
    assert [click.liquid for click in masks.points["3"]] == [True, False]
    assert Masks.model_validate({"provider": "sam3", "checkpoint": "x"}).text == "liquid"


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ({"provider": "sam3"}, 'checkpoint must be given with provider = "sam3"'),
        ({"checkpoint": "x"}, 'checkpoint must be given with provider = "sam3"'),
        ({"provider": "folder", "folder": "m", "text": "water"}, "text is for provider"),
        ({"points": {"1": [{"frame": 1, "x": 1, "y": 1}]}}, "points is for provider"),
        ({"provider": "sam3", "checkpoint": "x", "folder": "m"}, "folder must be given with"),
        ({"provider": "sam3", "checkpoint": "x", "text": " "}, "say what to look for"),
        ({"provider": "sam3", "checkpoint": "x", "points": {"1": []}}, "points.1"),
        (
            {"provider": "sam3", "checkpoint": "x", "points": {"1": [{"frame": 4, "x": 1, "y": 1, "liquid": False}]}},
            "no click on liquid in frame 4",
        ),
        ({"provider": "sam3", "checkpoint": "x", "points": {"1": [{"frame": -1, "x": 1, "y": 1}]}}, "frame"),
        ({"provider": "sam3", "checkpoint": "x", "confidence": 1.0}, "confidence"),
    ],
)
def test_prompts_go_with_their_provider(data: dict[str, Any], message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        Masks.model_validate(data)
