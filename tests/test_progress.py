"""Progress: a line every ten seconds into a log, a bar on a terminal, nothing on standard output."""

from __future__ import annotations

import sys
from collections.abc import Iterator

import pytest

from splashbench import progress
from splashbench.progress import Bar, track


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every look at the clock is six seconds after the last."""
    times = iter(range(0, 10_000, 6))
    monkeypatch.setattr(progress.time, "monotonic", lambda: next(times))


@pytest.mark.usefixtures("clock")
def test_a_log_gets_a_line_every_ten_seconds(capsys: pytest.CaptureFixture[str]) -> None:
    assert list(track([1, 2, 3, 4], "carving")) == [1, 2, 3, 4]
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.splitlines() == ["carving: 1 of 4", "carving: 3 of 4"]


@pytest.mark.usefixtures("clock")
def test_without_a_length_the_count_alone_is_shown(capsys: pytest.CaptureFixture[str]) -> None:
    def items() -> Iterator[int]:
        yield from (1, 2)

    assert list(track(items(), "carving")) == [1, 2]
    assert capsys.readouterr().err.splitlines() == ["carving: 1"]


@pytest.mark.usefixtures("clock")
def test_a_fraction_reported_from_elsewhere_gets_lines_too(capsys: pytest.CaptureFixture[str]) -> None:
    bar = Bar("fit")
    for fraction in (0.1, 0.25, 0.5):
        bar.update(fraction, "1.2 dB")
    bar.close()
    assert capsys.readouterr().err.splitlines() == ["fit:  25% 1.2 dB"]


@pytest.mark.parametrize("terminal", [True, False])
def test_why_a_bar_stands_still_is_shown_at_once(
    terminal: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys.stderr, "isatty", lambda: terminal)
    bar = Bar("fetch")
    bar.update(0.5)
    bar.hold("again in 2 s")
    assert "again in 2 s" in capsys.readouterr().err
    bar.close()


def test_a_bar_never_goes_backwards(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    bar = Bar("fit")
    for fraction in (0.5, 0.2, 7.0):
        bar.update(fraction)
        assert bar._bar.n == pytest.approx(0.5 if fraction < 1 else 1.0)
    bar.close()
    captured = capsys.readouterr()
    assert "fit: 100%" in captured.err
    assert captured.out == ""


def test_no_text_of_a_method_or_scene_takes_over_the_terminal(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(progress, "_LOG_INTERVAL_SECONDS", 0.0)
    bar = progress.Bar("a\x1b[2J")
    bar.update(0.5, "b\x1b]0;title\x07\nc")
    list(progress.track([1, 2], "view \x1b[31m"))
    printed = capsys.readouterr().err
    assert "\x1b" not in printed
    assert "\x07" not in printed
    assert "a?[2J:  50% b?]0;title? c" in printed
