"""Text files of data: bounded in nesting and in what they make of memory, and Unicode throughout."""

from __future__ import annotations

import time
from pathlib import Path

import pytest
from pydantic import BaseModel

from splashbench import toml
from splashbench.errors import SplashbenchError
from splashbench.files import read_json, write_model, write_text
from splashbench.files.documents import MAX_NESTING


@pytest.mark.parametrize(
    "text",
    [
        "a = " + "[" * (MAX_NESTING + 1) + "]" * (MAX_NESTING + 1),
        "a = " + "{b = " * 100 + "1" + "}" * 100,
        ".".join(["a"] * 400) + " = 1",
        "[" + ".".join(["a"] * 400) + "]",
        "x = {" + " . ".join(['"a"'] * 400) + " = 1}",
    ],
    ids=["lists", "tables", "key", "header", "quoted key within a table"],
)
def test_toml_that_could_not_be_written_again_is_refused(text: str, tmp_path: Path) -> None:
    (path := tmp_path / "deep.toml").write_text(text)
    with pytest.raises(
        SplashbenchError, match=r"deep\.toml cannot be read as TOML \((more than|a key of more than) 32"
    ):
        toml.load(path)


def test_a_key_of_very_many_parts_takes_no_time(tmp_path: Path) -> None:
    (path := tmp_path / "key.toml").write_text("a." * 8000 + "b = 1")  # the parser alone: seconds and half a gigabyte
    began = time.process_time()
    with pytest.raises(SplashbenchError):
        toml.load(path)
    assert time.process_time() - began < 0.5


def test_texts_comments_and_numbers_may_hold_any_number_of_dots(tmp_path: Path) -> None:
    dots = "a." * 100
    text = f'# {dots}\na = "{dots}"\nb = \'{dots}\'\nc = """{dots}\n"{dots}"""\nd = \'\'\'{dots}\'\'\'\n'
    (path := tmp_path / "dots.toml").write_text(text + "e = [" + "0.5, " * 100 + ']\nf.g."h.i" = 1\n')
    data = toml.load(path)
    assert data["a"] == data["b"] == data["d"] == dots
    assert data["c"] == f'{dots}\n"{dots}'
    assert data["f"] == {"g": {"h.i": 1}}


@pytest.mark.parametrize("quote", ['"""', "'''", '"', "'"])
def test_a_text_that_is_not_closed_takes_no_time(quote: str, tmp_path: Path) -> None:
    (path := tmp_path / "open.toml").write_text(f"a = {quote}" + '\\"' * 200_000)
    began = time.process_time()
    with pytest.raises(SplashbenchError):
        toml.load(path)
    assert time.process_time() - began < 2


def test_json_is_bounded_in_nesting_and_values(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.json"
    path.write_text("[" * MAX_NESTING + "]" * MAX_NESTING)
    read_json(path)
    path.write_text('{"a":' * 100 + "1" + "}" * 100)
    with pytest.raises(SplashbenchError, match="more than 32 lists or tables"):
        read_json(path)
    monkeypatch.setattr("splashbench.files.documents.MAX_VALUES", 1000)
    path.write_text("[" + "[]," * 1000 + "[]]")
    with pytest.raises(SplashbenchError, match="more than 1000 values"):
        read_json(path)


@pytest.mark.parametrize("text", ['{"a": "\\ud800"}', '{"\\uDFFF": 1}', '["\\ud83d \\ude00"]'])
def test_half_a_surrogate_pair_is_refused(text: str, tmp_path: Path) -> None:
    (path := tmp_path / "a.json").write_text(text)
    with pytest.raises(SplashbenchError, match="half of a surrogate pair"):
        read_json(path)


def test_a_whole_surrogate_pair_is_a_character(tmp_path: Path) -> None:
    (path := tmp_path / "a.json").write_text('"\\ud83d\\ude00 \\\\ud800"')
    assert read_json(path) == "\U0001f600 \\ud800"


def test_what_cannot_be_written_is_one_line_and_leaves_nothing(tmp_path: Path) -> None:
    class Free(BaseModel):
        a: object

    for value in ("\ud800", object(), [[[]]]):
        for _ in range(300 if isinstance(value, list) else 0):
            value = [value]
        with pytest.raises(SplashbenchError, match=r"a\.json cannot be written as JSON"):
            write_model(tmp_path / "a.json", Free(a=value))
    with pytest.raises(SplashbenchError, match=r"a\.txt cannot be written as UTF-8"):
        write_text(tmp_path / "a.txt", "\udc80")
    assert list(tmp_path.iterdir()) == []
