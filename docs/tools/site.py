"""Hooks of the documentation site (mkdocs.yml): pages from outside docs/, links out of the site, formulas as MathML.

GitHub and the site show the same files. Their links are relative to the repository, so a link to another page is
turned to that page, and a link to a file that the site does not show becomes plain text. A line that is a link to a
script of examples/ and nothing else becomes the script.
"""

from __future__ import annotations

import posixpath
import re
from pathlib import Path
from typing import Any

from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).parents[2]
#: Pages that stand elsewhere in the repository: pattern of the file -> page of the site, {} for the folder's name.
_OUTSIDE = {
    "README.md": "index.md",
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changelog.md",
    "examples/README.md": "{}_readme.md",
    "methods/*/README.md": "methods/{}.md",
    "benchmarks/README.md": "{}.md",
    "data_manifest/README.md": "{}.md",
    "leaderboards/README.md": "{}.md",
}
_LINK = re.compile(r"(!?)\[((?:[^\[\]]|\[[^\]]*\])*)\]\(([^)\s]+)\)")
_SCRIPT = re.compile(r"^\[[^\]]*\]\([./]*(examples/\w+\.py)\)$", re.MULTILINE)
_SOURCE = re.compile(r'(src=")([^"]+)(")')
_LOAD = re.compile(r"<(?:script|img|iframe|link)\b[^>]*(?:src|href)=[\"']?((?:https?:)?//[^\"'\s>]+)")
_FORMULA = re.compile(r'<(span|div) class="arithmatex">\\[(\[](.*?)\\[)\]]</\1>', re.DOTALL)


def outside_pages(root: Path = ROOT) -> dict[str, str]:
    """Repository path -> page, of all pages from outside docs/."""
    return {
        path.relative_to(root).as_posix(): page.format(path.parent.name)
        for pattern, page in _OUTSIDE.items()
        for path in sorted(root.glob(pattern))
    }


def on_files(files: Files, config: Any) -> Files:
    """Add the pages from outside docs/."""
    for path, page in outside_pages().items():
        text = (ROOT / path).read_text(encoding="utf-8")
        files.append(File.generated(config, page, content=rewritten(text, path, page)))
    return files


def on_page_markdown(markdown: str, page: Any, config: Any, files: Files) -> str:
    """Turn the links of a page of docs/."""
    if page.file.generated_by:
        return markdown
    return rewritten(markdown, f"docs/{page.file.src_uri}", page.file.src_uri)


def on_page_content(html: str, page: Any, config: Any, files: Files) -> str:
    """Formulas as MathML, which browsers draw by themselves."""
    import html as escaping

    from latex2mathml.converter import convert

    def drawn(match: re.Match[str]) -> str:
        display = "block" if match[1] == "div" else "inline"
        return str(convert(escaping.unescape(match[2]).strip(), display=display))

    return _FORMULA.sub(drawn, html)


def on_post_page(output: str, page: Any, config: Any) -> str:
    """Refuse a page that loads something from the network: the site works without."""
    loads = _LOAD.findall(output)
    if loads:
        raise PluginError(f"{page.file.src_uri} loads {loads[0]} from the network")
    return output


def rewritten(text: str, path: str, page: str, root: Path = ROOT) -> str:
    """`text` of the repository's file `path`, with its links as the site's `page` needs them; code stays as it is."""
    pages = outside_pages(root)
    text = _SCRIPT.sub(lambda match: f"```python\n{(root / match[1]).read_text(encoding='utf-8')}```", text)

    def target(link: str) -> str | None:
        """The link on the site, or None where the site does not show the file."""
        place, hash_, anchor = link.partition("#")
        if not place or re.match(r"[a-z]+:", link):
            return link
        file = posixpath.normpath(posixpath.join(posixpath.dirname(path), place))
        if (root / file).is_dir():
            file = f"{file}/README.md"
        shown = pages.get(file) or (file[len("docs/") :] if file.startswith("docs/") else None)
        if shown is None:
            return None
        return posixpath.relpath(shown, posixpath.dirname(page) or ".") + hash_ + anchor

    def link(match: re.Match[str]) -> str:
        place = target(match[3])
        return match[2] if place is None else f"{match[1]}[{_LINK.sub(link, match[2])}]({place})"

    def source(match: re.Match[str]) -> str:
        return f"{match[1]}{target(match[2]) or match[2]}{match[3]}"

    parts = re.split(r"(^```.*?^```$)", text, flags=re.DOTALL | re.MULTILINE)
    return "".join(p if i % 2 else _SOURCE.sub(source, _LINK.sub(link, p)) for i, p in enumerate(parts))
