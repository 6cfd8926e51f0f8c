"""The pictures of README.md are small, and links lead to the same places on the site."""

from __future__ import annotations

import runpy
from pathlib import Path
from typing import Any

import imageio.v3 as imageio
import pytest

ROOT = Path(__file__).parents[2]
README_BYTES = 400_000


def test_the_first_pages_pictures_are_small() -> None:
    pictures = ["docs/images/test_view.png", "docs/results/charts/quality_over_time.png"]
    assert sum((ROOT / path).stat().st_size for path in pictures) < README_BYTES
    assert all(f"({path})" in (ROOT / "README.md").read_text(encoding="utf-8") for path in pictures)


def test_the_viewers_picture_is_small_and_on_the_first_page() -> None:
    picture = ROOT / "docs" / "images" / "viewer.png"
    assert picture.stat().st_size < README_BYTES
    assert imageio.imread(picture).shape[1] == 1200
    assert picture.name in (ROOT / "README.md").read_text(encoding="utf-8")


def test_links_of_the_site() -> None:
    pytest.importorskip("mkdocs", reason="comes with the extra [docs]")
    site = runpy.run_path(str(ROOT / "docs" / "tools" / "site.py"))
    rewritten: Any = site["rewritten"]
    text = "[a](docs/protocol.md#rules) [b](CONTRIBUTING.md) [c](Makefile) [d](#here) ![e](docs/images/x.png)"
    expected = "[a](protocol.md#rules) [b](contributing.md) c [d](#here) ![e](images/x.png)"
    assert rewritten(text, "README.md", "index.md") == expected
    text = "[a](../methods/splashsplat/README.md) [b](../README.md) `[c](d.md)`\n\n[e](../examples/add_a_method.py)\n"
    shown = rewritten(text, "docs/reference.md", "reference.md")
    assert shown.startswith("[a](methods/splashsplat.md) [b](index.md)")
    assert "class NearestView(Method)" in shown
