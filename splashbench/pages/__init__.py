"""HTML pages that need nothing but themselves: templates, one style, and what is embedded.

A page is a template that extends `page.html.j2`. All text is escaped; data for scripts goes in by `as_json`. The filter
`plain` makes one line without control characters of a stranger's text, such as those that turn its direction around.
"""

from __future__ import annotations

import base64
import json
from pathlib import Path
from typing import Any

from jinja2 import ChoiceLoader, Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from splashbench.errors import one_line

_HERE = Path(__file__).parent


def render(folder: Path, template: str, **content: Any) -> str:
    """The page that `template`, a file in `folder`, makes of `content`; the same bytes for the same content."""
    environment = Environment(
        loader=ChoiceLoader([FileSystemLoader(folder), FileSystemLoader(_HERE)]),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.globals.update(embedded=embedded, as_json=as_json)
    environment.filters["plain"] = one_line
    return environment.get_template(template).render(folder=folder, pages=_HERE, **content)


def embedded(folder: Path, name: str) -> Markup:
    """A style sheet or script of ours, as it is."""
    return Markup((folder / name).read_text(encoding="utf-8"))


def as_json(data: Any) -> Markup:
    """`data` for a `<script type="application/json">`: nothing in it can end the element. Raises ValueError for NaN."""
    text = json.dumps(data, allow_nan=False, ensure_ascii=True, separators=(",", ":"))
    return Markup(text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026"))


def data_uri(content: bytes, kind: str) -> str:
    """`content` of the MIME type `kind` as an address that holds it."""
    return f"data:{kind};base64,{base64.b64encode(content).decode()}"
