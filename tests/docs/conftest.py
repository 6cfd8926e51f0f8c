"""The documents under test: every Markdown file that people read, as the repository has them."""

from __future__ import annotations

from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
_PATTERNS = (
    *("README.md", "CONTRIBUTING.md", "CHANGELOG.md", "docs/**/*.md", "methods/*/README.md", "examples/README.md"),
    *("benchmarks/README.md", "data_manifest/README.md", "leaderboards/README.md"),
)


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Run what takes a `document` once for each of them."""
    if "document" in metafunc.fixturenames:
        paths = sorted({path for pattern in _PATTERNS for path in ROOT.glob(pattern)})
        metafunc.parametrize("document", paths, ids=[path.relative_to(ROOT).as_posix() for path in paths])
