"""Every `splashbench ...` line of the documents is one that the command line accepts."""

from __future__ import annotations

import argparse
import re
import shlex
from collections.abc import Iterator
from pathlib import Path

import pytest

from splashbench.cli.main import build_parser

#: What a reader fills in, where the command line wants a number.
_NUMBERS = {"N": "3", "M": "0.03", "SECONDS": "10", "K": "1"}
#: Pages that tell what commands were called before.
_HISTORY = {"CHANGELOG.md"}


def commands(text: str) -> Iterator[list[str]]:
    """Arguments of each splashbench command in the text's code blocks, fenced or indented."""
    blocks = re.findall(r"^ *```(?:sh|bash|console|text)?\n(.*?)^ *```", text, re.DOTALL | re.MULTILINE)
    blocks += re.findall(r"(?:^(?: {4}|\t).*\n?)+", re.sub(r"```.*?```", "", text, flags=re.DOTALL), re.MULTILINE)
    for block in blocks:
        lines = re.sub(r"\\\n\s*", " ", block).splitlines()
        for line in lines:
            for loop in re.findall(r"for (\w+) in ([^;]+);", line):
                line = line.replace(f"${loop[0]}", loop[1].split()[0])
            for part in re.split(r"&&|;|\||(?<=\s)do\s", line):
                part = part.strip().removeprefix("$ ")
                if re.match(r"splashbench\s+\S", part):
                    # An explanation beside the command stands after two spaces and more, or after a "#".
                    yield shlex.split(re.split(r"\s{3,}(?=[a-z])", part)[0], comments=True)[1:]


def inline_commands(text: str) -> list[list[str]]:
    """Words of each `splashbench ...` within a sentence: a command's name, perhaps with some of its arguments."""
    text = re.sub(r"^ *```.*?^ *```", "", text, flags=re.DOTALL | re.MULTILINE)
    spans = re.findall(r"(?<!`)`splashbench\s+([a-z][^`]*)`", text)
    return [span.split() for span in spans]


def refusal(arguments: list[str]) -> str | None:
    """Why the command line does not accept the arguments; None where it does."""
    parser = build_parser()
    words = [_NUMBERS.get(word, word) for word in arguments if not re.fullmatch(r"\[.*\]", word)]
    if "--help" in words or "--version" in words:
        return inline_refusal(words)

    def fail(message: str) -> None:
        raise ValueError(message)

    for each in _all_parsers(parser):
        each.error = fail  # type: ignore[assignment]
    try:
        parser.parse_args(words)
    except (ValueError, argparse.ArgumentError) as error:
        return str(error)
    return None


def inline_refusal(words: list[str]) -> str | None:
    """Why there is no such command or option; None where there is. Other arguments may be missing."""
    parser = build_parser()
    words = list(words)
    while words and (choices := _subcommands(parser)):
        name = words.pop(0)
        if name.isupper() or name.startswith("-"):
            words.insert(0, name)
            break
        for each in name.split("|"):
            if each not in choices:
                return f"there is no command {each}"
        parser = choices[name.split("|")[0]]
    known = parser._option_string_actions
    for word in words:
        option = word.strip("[],.;|").partition("=")[0]
        if option.startswith("--") and option not in known:
            return f"{parser.prog} has no option {option}"
    return None


def _subcommands(parser: argparse.ArgumentParser) -> dict[str, argparse.ArgumentParser]:
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            return action.choices  # type: ignore[return-value]
    return {}


def _all_parsers(parser: argparse.ArgumentParser) -> Iterator[argparse.ArgumentParser]:
    yield parser
    for child in _subcommands(parser).values():
        yield from _all_parsers(child)


def test_commands_are_accepted(document: Path) -> None:
    if document.name in _HISTORY:
        pytest.skip("tells of earlier releases")
    text = document.read_text(encoding="utf-8")
    faults = [f"splashbench {shlex.join(c)}: {fault}" for c in commands(text) if (fault := refusal(c))]
    faults += [f"splashbench {' '.join(c)}: {fault}" for c in inline_commands(text) if (fault := inline_refusal(c))]
    assert faults == []


@pytest.mark.parametrize(
    "text",
    [
        "    splashbench ron splashsplat SCENE OUT\n",
        "    splashbench run splashsplat SCENE OUT --pre-set quick\n",
        "    splashbench run splashsplat SCENE\n",
        "```\nsplashbench score SUBMISSION --out RESULTS\n```\n",
        "    cd x && splashbench prepare\n",
    ],
)
def test_a_wrong_command_is_found(text: str) -> None:
    (arguments,) = commands(text)
    assert refusal(arguments)


@pytest.mark.parametrize("text", ["`splashbench scene plaice`", "`splashbench run --pre-set`"])
def test_a_wrong_command_within_a_sentence_is_found(text: str) -> None:
    (words,) = inline_commands(text)
    assert inline_refusal(words)


def test_what_is_accepted() -> None:
    text = """
    splashbench run splashsplat SCENE OUT --seed 1          a note for people
    splashbench synth scene balls OUT    # another
    for name in opaque_bowl thin_stream; do splashbench synth scene $name scenes/$name --size 240x160; done
    splashbench run splashsplat \\
        SCENE OUT
"""
    found = list(commands(text))
    assert len(found) == 4
    assert [refusal(arguments) for arguments in found] == [None] * 4
