"""The committed leaderboard's rows can be run again: by the methods as they are, or by the release that is named."""

from __future__ import annotations

import csv
import hashlib
import json
import re
from pathlib import Path

import pytest

from splashbench.harness.discovery import load_method

ROOT = Path(__file__).parents[2]
TABLE = ROOT / "leaderboards" / "synthetic.csv"
README = ROOT / "leaderboards" / "README.md"


def digest_of(method: str, preset: str) -> str:
    """Eight digits of version and settings, computed here by the formula of leaderboards/README.md."""
    chosen = load_method(method)
    values = chosen.Config.preset(preset, {}).model_dump(mode="json")
    return hashlib.sha256(json.dumps([chosen.version, values], sort_keys=True).encode()).hexdigest()[:8]


def rows() -> list[tuple[str, str, str, str]]:
    names = ("method", "preset", "method_version", "settings_digest")
    with TABLE.open(encoding="utf-8", newline="") as stream:
        return sorted({tuple(row[name] for name in names) for row in csv.DictReader(stream)})


@pytest.mark.parametrize(("method", "preset", "version", "digest"), rows())
def test_a_row_can_be_run_again(method: str, preset: str, version: str, digest: str) -> None:
    """A row of today's version has today's settings; one of an earlier version is named with its release."""
    if version == load_method(method).version:
        assert digest == digest_of(method, preset)
    else:
        assert f"| `{method}` | {version} | 0.2.0 |" in README.read_text(encoding="utf-8")


def test_only_rows_of_earlier_versions_are_named_as_such() -> None:
    named = re.findall(r"^\| `(\w+)` \| (\w+) \| 0\.2\.0 \|$", README.read_text(encoding="utf-8"), re.MULTILINE)
    assert named
    assert set(named) <= {(method, version) for method, _, version, _ in rows()}
    assert all(version != load_method(method).version for method, version in named)


def test_the_rows_of_masks_alone_are_told_by_their_digest() -> None:
    (digest,) = re.findall(r"`settings_digest` ([0-9a-f]{8})", README.read_text(encoding="utf-8"))
    assert digest in {digest for method, _, _, digest in rows() if method == "splashsplat"}
