"""Every relative link of the documents leads to a file, and to a heading where it names one."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
_FENCED = re.compile(r"^( *)```.*?^\1```", re.DOTALL | re.MULTILINE)
_CODE = re.compile(r"(`+)(?!`).*?(?<!`)\1(?!`)", re.DOTALL)
_LINK = re.compile(r"\[(?:[^\[\]]|\[[^\]]*\])*\]\(([^)\s]+)(?:\s+\"[^\"]*\")?\)|(?:src|href)=\"([^\"]+)\"")


def links(text: str) -> list[str]:
    """Targets of the links of a Markdown text, those within code left out."""
    text = _CODE.sub("code", _FENCED.sub("", text))
    # A picture may stand within a link, so both are looked for.
    return [target for match in re.finditer(r"(?=\[|src=|href=)", text) if (target := _target(text, match.end()))]


def _target(text: str, place: int) -> str | None:
    match = _LINK.match(text, place)
    return (match[1] or match[2]) if match else None


def anchors(text: str) -> set[str]:
    """Anchors of a Markdown text's headings, as GitHub and the site make them."""
    names: set[str] = set()
    for heading in re.findall(r"^#{1,6} +(.+?) *#*$", _FENCED.sub("", text), re.MULTILINE):
        plain = re.sub(r"!?\[([^\]]*)\]\([^)]*\)", r"\1", heading).replace("`", "")
        plain = re.sub(r"(?<!\w)[*_]+|[*_]+(?!\w)", "", plain)
        base = re.sub(r"[^\w\- ]", "", plain.strip().lower()).replace(" ", "-")
        name, n = base, 0
        while name in names:
            n += 1
            name = f"{base}-{n}"
        names.add(name)
    return names


def broken(path: Path, text: str) -> list[str]:
    """Links of the document `path` that lead nowhere."""
    faults = []
    for link in links(text):
        if re.match(r"(https?|mailto):", link):
            continue
        place, _, anchor = link.partition("#")
        target = (path.parent / place).resolve() if place else path
        if not target.is_relative_to(ROOT) or not target.exists():
            faults.append(f"{link}: there is no such file")
        elif anchor and target.suffix == ".md":
            own = text if target == path else target.read_text(encoding="utf-8")
            if anchor not in anchors(own):
                faults.append(f"{link}: there is no such heading")
    return faults


def test_links_lead_somewhere(document: Path) -> None:
    assert broken(document, document.read_text(encoding="utf-8")) == []


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("[a](no_such_file.md)", "no_such_file.md: there is no such file"),
        ("[a](../../../etc/passwd)", "../../../etc/passwd: there is no such file"),
        ("# One\n\n[a](#two)", "#two: there is no such heading"),
        ("[![picture](no_such.png)](README.md)", "no_such.png: there is no such file"),
        ('<img src="no_such.png">', "no_such.png: there is no such file"),
    ],
)
def test_a_broken_link_is_found(text: str, fault: str) -> None:
    assert broken(ROOT / "README.md", text) == [fault]


def test_what_is_no_broken_link() -> None:
    text = "# A `code`, and *more* of_it\n\n[a](#a-code-and-more-of_it) `[b](none.md)`\n\n```\n[c](none.md)\n```\n"
    assert broken(ROOT / "README.md", text) == []
