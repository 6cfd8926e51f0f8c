"""The committed leaderboard's rows can be run again: versions and settings are those of the methods as they are."""

from __future__ import annotations

import csv
import hashlib
import json
from pathlib import Path

import pytest

from splashbench.harness.discovery import load_method

TABLE = Path(__file__).parents[2] / "leaderboards" / "synthetic.csv"
MASKS_ALONE = {"container": False, "pool": False, "ballistic": False}


def digest_of(method: str, preset: str, settings: dict[str, bool]) -> str:
    """Eight digits of version and settings, computed here by the formula of leaderboards/README.md."""
    chosen = load_method(method)
    values = chosen.Config.preset(preset, settings).model_dump(mode="json")
    return hashlib.sha256(json.dumps([chosen.version, values], sort_keys=True).encode()).hexdigest()[:8]


def rows() -> list[tuple[str, str, str]]:
    with TABLE.open(encoding="utf-8", newline="") as stream:
        return sorted({(row["method"], row["preset"], row["settings_digest"]) for row in csv.DictReader(stream)})


@pytest.mark.parametrize(("method", "preset", "digest"), rows())
def test_a_row_has_the_settings_that_its_method_has_today(method: str, preset: str, digest: str) -> None:
    told = [{}, MASKS_ALONE] if method == "splashsplat" else [{}]
    assert digest in [digest_of(method, preset, settings) for settings in told]
