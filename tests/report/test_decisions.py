"""Decisions of a fit: how their figures are written, where their rungs stand, and that any of them can be drawn."""

from pathlib import Path

import numpy as np
import pytest

from splashbench.errors import SplashbenchError
from splashbench.files import image_size, read_image
from splashbench.report.decision_chart import MAX_PANELS, decision_chart
from splashbench.report.decision_text import (
    bytes_text,
    chosen_rung,
    gain_text,
    quality_text,
    rung_table,
    seconds_text,
    shortened,
)
from splashbench.report.ladder import ladder, scale
from splashbench.submission import Decision, Rung


def decision(*rungs: Rung, chosen: str = "none of them") -> Decision:
    return Decision(name="size", basis="scene", chosen=chosen, because="it is enough", measure="dB", rungs=list(rungs))


def test_costs_are_in_human_units() -> None:
    sizes = (None, 0.0, -12.0, 999.6, 410_000.0, -4_100_000.0, 1e15)
    assert [bytes_text(v, sign=True) for v in sizes] == [*("–", "0 B", "-12 B", "+1 kB", "+410 kB", "-4.1 MB", "+1 PB")]
    times = (0.25, 59.99, 75.0, 7200.0)
    assert [seconds_text(v) for v in times] == ["0.25 s", "1 min", "1.25 min", "2 h"]


def test_a_gain_has_the_decimals_that_its_error_supports() -> None:
    pairs = [(0.3, 0.041), (-1.0, 12.0), (0.01, None), (0.01, 0.0), (1e15, 1e15), (2.0, 1e-9), (None, 1.0)]
    texts = [gain_text(gain, error) for gain, error in pairs]
    assert texts == ["+0.300 ± 0.041", "-1 ± 12", "+0.01", "+0.01", "+1e+15 ± 1e+15", "+2 ± 1e-09", "–"]
    assert [quality_text(28.1, 29.0), quality_text(0.05, 0.06), quality_text(1e15, 1e15)] == [
        *("28.10", "0.0500", "1000000000000000")
    ]


def test_columns_without_a_figure_are_left_out() -> None:
    table = rung_table(decision(Rung(value="a", bought=True), Rung(value="b", bought=False, bytes=1.0, reason="no")))
    assert (table.header, table.rows) == (["value", "size"], [["a", "–"], ["b", "+1 B"]])
    assert table.verdicts == ["bought", "refused: no"]


def test_text_is_on_one_line_and_cut() -> None:
    assert shortened("a\n\x1b[1m b", 40) == "a ?[1m b"
    assert shortened("abcdef", 4) == "abc…"


def test_what_was_chosen_is_the_rung_of_that_value_else_the_last_that_was_bought() -> None:
    rungs = Rung(value="4", bought=True), Rung(value="8", bought=True), Rung(value="16", bought=False)
    assert chosen_rung(decision(*rungs, chosen="4")) == 0
    assert chosen_rung(decision(*rungs)) == 1
    assert chosen_rung(decision(rungs[2])) is None


def test_costs_and_gains_add_up_along_what_was_bought() -> None:
    found = ladder(
        decision(
            Rung(value="1 step", bought=True),
            Rung(value="2 steps", bought=True, gain=1.0, standard_error=0.1, seconds=2.0),
            Rung(value="3 steps", bought=False, gain=0.1, seconds=9.0),
            Rung(value="4 steps", bought=True, gain=0.5, seconds=3.0),
        )
    )
    assert found is not None
    assert (found.x, found.y) == ([0.0, 2.0, 11.0, 5.0], [0.0, 1.0, 1.1, 1.5])
    assert (found.before, found.errors) == ([None, 0, 1, 1], [0.0, 0.1, 0.0, 0.0])
    assert (found.x_label, found.y_label, found.ordered) == ("cost, added up (s)", "gain added up, dB", False)


def test_savings_are_drawn_rightwards_in_their_unit_under_short_names() -> None:
    found = ladder(
        decision(
            Rung(value="16 features", bought=True, quality=29.0),
            Rung(value="8 features", bought=True, quality=28.9, bytes=-4e6),
            Rung(value="4 features", bought=False, quality=27.0, bytes=-2e6),
        )
    )
    assert found is not None
    assert found.x == [0.0, 4.0, 6.0]
    assert found.x_label == "saving, added up (MB)"
    assert found.y == [29.0, 28.9, 27.0]
    assert found.names == ["16", "8", "4"]


def test_without_costs_of_all_rungs_they_stand_in_the_order_tried() -> None:
    found = ladder(
        decision(*(Rung(value=str(n), bought=True, quality=1.0, seconds=5.0 if n == 1 else None) for n in range(3)))
    )
    assert found is not None
    assert (found.x, found.ordered) == ([0.0, 1.0, 2.0], True)


def test_a_scale_is_of_costs_else_of_values_with_one_unit() -> None:
    assert ladder(decision(Rung(value="4 mm", bought=True))) is None
    found = scale(decision(Rung(value="4.5 mm of a pixel", bought=True), Rung(value="8 mm", bought=False)))
    assert found is not None
    assert (found.lengths, found.label) == ([4.5, 8.0], "mm")
    assert scale(decision(Rung(value="4 mm", bought=True), Rung(value="1 m", bought=False))) is None
    assert scale(decision(Rung(value="fine", bought=True))) is None
    assert scale(decision()) is None
    costs = scale(
        decision(Rung(value="fine", bought=True, seconds=60.0), Rung(value="finer", bought=False, seconds=120.0))
    )
    assert costs is not None
    assert (costs.lengths, costs.label) == ([1.0, 3.0], "cost, added up (min)")


@pytest.mark.parametrize(
    "rungs",
    [
        [],
        [Rung(value="fine", bought=False, reason="word " * 100)],
        [Rung(value=f"{n} mm", bought=n % 2 == 0) for n in range(40)],
        [Rung(value=w, bought=True, reason="$\\frac{") for w in "abcdefghijklmnop"],
        [Rung(value="1e99 m", bought=True), Rung(value="-999999999999999e99 m", bought=False)],
        [Rung(value="0 m", bought=True), Rung(value="0 m", bought=True)],
        [Rung(value=str(n), bought=True, quality=1e15 * (-1) ** n, standard_error=1e15) for n in range(40)],
        [Rung(value=str(n), bought=True, gain=1e15, seconds=1e15, bytes=None) for n in range(40)],
        [Rung(value="only", bought=False, quality=0.0, bytes=0.0)],
        [Rung(value="a", bought=True, quality=1.0), Rung(value="b", bought=True, bytes=1.0)],
    ],
)
@pytest.mark.filterwarnings("error")
def test_whatever_a_record_may_hold_can_be_drawn(rungs: list[Rung], tmp_path: Path) -> None:
    path = tmp_path / "chart.png"
    assert decision_chart("title", [decision(*rungs)], path) == 0
    assert np.unique(read_image(path).reshape(-1, 3), axis=0).shape[0] > 20


def test_fifty_decisions_are_a_page_of_panels_and_a_count(tmp_path: Path) -> None:
    one = decision(*(Rung(value=f"{n} steps", bought=True, quality=n**0.5, seconds=1.0) for n in range(40)))
    path = tmp_path / "chart.png"
    assert decision_chart("title", [one] * 50, path) == 50 - MAX_PANELS
    width, height = image_size(path)
    assert 1000 < width < 3000
    assert 1000 < height < 3000


def test_only_pictures_of_two_kinds_are_drawn(tmp_path: Path) -> None:
    with pytest.raises(SplashbenchError, match=r"neither \.png nor \.svg"):
        decision_chart("title", [decision()], tmp_path / "chart.pdf")
    with pytest.raises(SplashbenchError, match="no decision to draw"):
        decision_chart("title", [], tmp_path / "chart.svg")
