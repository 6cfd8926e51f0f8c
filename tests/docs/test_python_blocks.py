"""Python in the documents compiles; that of the tutorial runs, in the folder that its commands have left."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
_BLOCK = re.compile(r"^( *)```(?:python|py)\n(.*?)^\1```", re.DOTALL | re.MULTILINE)


def blocks(text: str) -> list[str]:
    """The text's Python blocks."""
    return [re.sub(f"^{indent}", "", code, flags=re.MULTILINE) for indent, code in _BLOCK.findall(text)]


def test_python_compiles(document: Path) -> None:
    for i, code in enumerate(blocks(document.read_text(encoding="utf-8"))):
        compile(code, f"{document.name}, block {i + 1}", "exec", dont_inherit=True)


def test_what_does_not_compile_is_found() -> None:
    (code,) = blocks("```python\nprint('a'\n```\n")
    with pytest.raises(SyntaxError):
        compile(code, "block", "exec")


def test_the_tutorials_python_runs(
    balls_directory: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(balls_directory, tmp_path / "scenes" / "monday")
    monkeypatch.chdir(tmp_path)
    page = ROOT / "docs" / "tutorial.md"
    code = blocks(page.read_text(encoding="utf-8"))
    assert code
    names: dict[str, object] = {}
    for block in code:
        exec(compile(block, page.name, "exec", dont_inherit=True), names)
    assert "balls" in capsys.readouterr().out
