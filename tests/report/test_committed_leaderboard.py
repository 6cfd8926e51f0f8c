"""The committed leaderboard's rows can be run again: versions and settings are those of the methods as they are."""

from __future__ import annotations

import csv
import hashlib
import json
import runpy
from pathlib import Path

import pytest

from splashbench.harness.discovery import load_method

ROOT = Path(__file__).parents[2]
TABLE = ROOT / "leaderboards" / "synthetic.csv"
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


def test_the_rows_of_masks_alone_are_told_by_their_digest() -> None:
    digest = digest_of("splashsplat", "best", MASKS_ALONE)
    assert ("splashsplat", "best", digest) in rows()
    assert runpy.run_path(str(ROOT / "docs" / "tools" / "pictures.py"))["MASKS_ALONE"] == digest
    assert f"`settings_digest` {digest}" in (ROOT / "leaderboards" / "README.md").read_text(encoding="utf-8")
