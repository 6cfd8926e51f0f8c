"""Help: every command describes itself and each of its options, and its examples are ones that the parser takes."""

from __future__ import annotations

import argparse
import re
import shlex

import pytest

from splashbench.cli.command import subcommands
from splashbench.cli.main import COMMANDS, build_parser, main

Words = tuple[str, ...]


def _parsers() -> dict[Words, argparse.ArgumentParser]:
    """Every command, `splashbench` itself included, by the words that follow the program's name."""
    parsers: dict[Words, argparse.ArgumentParser] = {}

    def walk(words: Words, parser: argparse.ArgumentParser) -> None:
        parsers[words] = parser
        for name, child in subcommands(parser).items():
            walk((*words, name), child)

    walk((), build_parser())
    return parsers


PARSERS = _parsers()
each_command = pytest.mark.parametrize("words", PARSERS, ids=lambda words: " ".join(words) or "splashbench")


def examples(epilog: str | None) -> list[str]:
    """The lines `splashbench ...` of an epilog, continued lines joined, without the remarks behind them."""
    joined = re.sub(r"\\\n\s*", "", epilog or "")
    lines = [line.strip() for line in joined.splitlines()]
    return [re.split(r"\s{2,}", line)[0] for line in lines if line.startswith("splashbench ")]


@each_command
def test_every_command_describes_itself(words: Words) -> None:
    parser = PARSERS[words]
    assert parser.description
    assert len(parser.description.split()) >= 4
    assert parser.description.rstrip().endswith(".")


@each_command
def test_every_argument_has_a_help(words: Words) -> None:
    for action in PARSERS[words]._actions:
        if isinstance(action, argparse._SubParsersAction):
            summaries = {choice.dest: choice.help for choice in action._choices_actions}
            assert summaries.keys() == action.choices.keys()
            assert all(summary and len(summary.split()) >= 3 for summary in summaries.values())
        else:
            assert action.help, f"{action.option_strings or action.dest} has no help"


@each_command
def test_every_command_shows_an_example_of_itself(words: Words) -> None:
    start = " ".join(["splashbench", *words, ""])
    assert any(f"{line} ".startswith(start) for line in examples(PARSERS[words].epilog))


@pytest.mark.parametrize(
    "line", sorted({line for parser in PARSERS.values() for line in examples(parser.epilog)}), ids=lambda line: line
)
def test_every_example_is_one_that_the_parser_takes(line: str, capsys: pytest.CaptureFixture[str]) -> None:
    try:
        arguments = build_parser().parse_args(shlex.split(line)[1:])
    except SystemExit:
        pytest.fail(capsys.readouterr().err)
    assert callable(arguments.handler)


@each_command
def test_help_is_printed_with_its_epilog_as_written(words: Words, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main([*words, "--help"])
    assert stop.value.code == 0
    printed = capsys.readouterr().out
    assert printed.startswith(" ".join(["usage: splashbench", *words]))
    assert (PARSERS[words].epilog or "?").strip() in printed
    assert max(map(len, printed.splitlines())) <= 120


@each_command
def test_every_command_that_works_can_print_json(words: Words) -> None:
    parser = PARSERS[words]
    assert bool(subcommands(parser)) != ("--json" in parser._option_string_actions)


def test_every_module_of_a_command_is_registered_under_its_name() -> None:
    assert tuple(subcommands(PARSERS[()])) == COMMANDS


def test_wrong_usage_is_exit_2(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["run", "splashsplat"])
    assert stop.value.code == 2
    assert "required: SCENE, OUT" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["run", "external", "SCENE", "OUT", "--name", "x"], "splashbench run-external SCENE OUT --name"),
        (["scene", "place", "SCENE", "MESH"], "splashbench scene place-container SCENE MESH"),
        (["scene", "container", "SCENE"], "splashbench scene reconstruct-container SCENE"),
        (["study", "ablate", "ablation", "OUT"], "splashbench study run SPEC OUT"),
        (["scroe", "SUBMISSION"], "`splashbench` has no command 'scroe'; did you mean `score`?"),
        (["scene", "chek", "SCENE"], "`splashbench scene` has no command 'chek'; did you mean `check`?"),
        (["synth", "x"], "`splashbench synth` has no command 'x'; there are session, scene, verify"),
    ],
)
def test_an_old_or_unknown_command_is_one_line(
    words: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(words) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.startswith("error: ")
    assert message in captured.err
    assert captured.err.count("\n") == 1


def test_external_is_no_method_wherever_it_stands(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["run", "--seed", "1", "external", "SCENE", "OUT"])
    assert stop.value.code == 2
    assert "METHOD external has a new name: splashbench run-external" in capsys.readouterr().err
    assert main(["methods", "show", "external"]) == 1
    assert "splashbench run-external --help" in capsys.readouterr().err


def test_a_word_in_the_place_of_a_folder_is_no_command(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", "nothing", "external", "OUT"]) == 1
    assert "external" in capsys.readouterr().err
