"""Pages: text stays text, data cannot end its element, and every block is drawn."""

import json
import re
from pathlib import Path

import pytest
from jinja2 import UndefinedError

from splashbench.pages import as_json, data_uri, render
from splashbench.pages.blocks import Bullets, Note, Picture, Sheet, Table

HOSTILE = "</script><b>&amp;"
TEMPLATE = """{% extends "page.html.j2" %}
{% from "blocks.html.j2" import draw %}
{% set title = name %}
{% block body %}{% for block in blocks %}{{ draw(block) }}{% endfor %}
<script type="application/json" id="data">{{ as_json(data) }}</script>{% endblock %}
"""


def page(folder: Path, **content: object) -> str:
    (folder / "a.html.j2").write_text(TEMPLATE)
    return render(folder, "a.html.j2", **{"name": "a page", "blocks": [], "data": None, **content})


def test_text_stays_text_in_every_block(tmp_path: Path) -> None:
    picture = Picture(data_uri(b"abc", "image/png"), HOSTILE, HOSTILE)
    blocks = [
        Table([HOSTILE], [[HOSTILE], ["plain"]], ["failed", "passed"]),
        Note(HOSTILE),
        Bullets([HOSTILE]),
        picture,
        Sheet([picture]),
    ]
    text = page(tmp_path, name=HOSTILE, blocks=blocks)
    assert "<b>" not in text
    assert text.count("&lt;/script&gt;&lt;b&gt;&amp;amp;") == 8
    assert '<tr class="failed"><td>' in text
    assert text.count('src="data:image/png;base64,YWJj"') == 2
    assert text == page(tmp_path, name=HOSTILE, blocks=blocks)


def test_data_comes_back_as_it_was_and_cannot_end_its_element(tmp_path: Path) -> None:
    data = {"name": HOSTILE, "values": [1.5, None, True], "comment": "<!-- -->\u2028"}
    text = page(tmp_path, data=data)
    found = re.search(r'id="data">(.*?)</script>', text, re.DOTALL)
    assert found is not None
    assert "<" not in found[1]
    assert json.loads(found[1]) == data
    with pytest.raises(ValueError, match="Out of range"):
        as_json([float("nan")])


def test_what_a_template_asks_for_and_is_not_given_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "b.html.j2").write_text("{{ missing }}")
    with pytest.raises(UndefinedError, match="missing"):
        render(tmp_path, "b.html.j2")
