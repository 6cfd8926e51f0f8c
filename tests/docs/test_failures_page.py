"""docs/failures.md explains every status that a run can have."""

from __future__ import annotations

import re
from pathlib import Path

from splashbench.submission import Status

PAGE = Path(__file__).parents[2] / "docs" / "failures.md"


def test_every_status_has_a_section() -> None:
    sections = re.findall(r"^### (\w+)$", PAGE.read_text(encoding="utf-8"), re.MULTILINE)
    assert sections == [status.value for status in Status]
