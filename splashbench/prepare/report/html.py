"""HTML of the report: its style, tables, lists, and pictures embedded so that the page needs nothing else."""

from __future__ import annotations

import base64
import html
import io
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splashbench.files import jpeg_bytes

TRAIN_COLOUR, TEST_COLOUR, SWEEP_COLOUR = "#1f5fa8", "#c2571a", "#9a9a9a"

STYLE = """
body { font: 15px/1.45 system-ui, sans-serif; margin: 2rem auto; max-width: 1080px; padding: 0 1rem; color: #1c1c1c; }
h1 { font-size: 1.5rem; } h2 { font-size: 1.15rem; margin-top: 2.2rem; border-bottom: 1px solid #ddd; }
table { border-collapse: collapse; } td, th { padding: .2rem .7rem; text-align: right; }
tr { border-bottom: 1px solid #eee; }
td:first-child, th:first-child, td.text, th.text { text-align: left; }
.passed { background: #dff2df; } .failed { background: #f7d6d2; }
img { max-width: 100%; } p.note { color: #555; }
.sheet { display: grid; grid-template-columns: repeat(3, 1fr); gap: 4px; }
figure { margin: 0; } figcaption { font-size: .8rem; color: #555; }
"""


def section(title: str, content: Iterable[str]) -> list[str]:
    """A heading and what stands below it."""
    return [f"<h2>{html.escape(title)}</h2>", *content]


def table(header: Sequence[str], rows: Iterable[Sequence[str]], classes: Iterable[str] | None = None) -> str:
    """An HTML table of text cells; `classes` of its rows colour them."""
    row_classes = iter(classes) if classes is not None else None
    lines = ["<table><tr>" + "".join(f"<th>{html.escape(cell)}</th>" for cell in header) + "</tr>"]
    for row in rows:
        attribute = f' class="{next(row_classes)}"' if row_classes is not None else ""
        lines.append(f"<tr{attribute}>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in row) + "</tr>")
    return "\n".join([*lines, "</table>"])


def bullets(lines: Iterable[str]) -> list[str]:
    """A bulleted list of lines of text."""
    return ["<ul>", *(f"<li>{html.escape(line)}</li>" for line in lines), "</ul>"]


def figure_html(figure: Any) -> str:
    """A matplotlib figure as an embedded PNG."""
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=110)
    return f'<p><img alt="" src="data:image/png;base64,{base64.b64encode(stream.getvalue()).decode()}"></p>'


def image_uri(image: NDArray[np.uint8]) -> str:
    """An RGB image uint8 [H, W, 3] as the address of an embedded JPEG."""
    return f"data:image/jpeg;base64,{base64.b64encode(jpeg_bytes(image, quality=88)).decode()}"
