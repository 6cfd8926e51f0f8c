"""How figures are written: units, decimals, signs, and the mark of the filter, with known answers."""

import math

import pytest

from splashbench.score import METRICS
from splashbench.score.notation import NO_FIGURE, filter_mark, label, shown, shown_with_spread, stored


@pytest.mark.parametrize(
    ("name", "value", "text"),
    [
        ("psnr", 20.126, "20.13"),
        ("peak_memory_bytes", 300 * 2**20, "300"),
        ("peak_device_memory_bytes", 1.5 * 2**30, "1536"),
        ("storage_bytes", 2_500_000, "2.50"),
        ("dynamic_bytes", 1_234_567, "1.23"),
        ("psnr", -0.001, "0.00"),
        ("psnr", None, NO_FIGURE),
        ("psnr", math.nan, NO_FIGURE),
    ],
)
def test_people_read_megabytes_and_the_registry_s_decimals(name: str, value: float | None, text: str) -> None:
    assert shown(METRICS[name], value) == text


def test_a_difference_has_its_sign_unless_it_rounds_to_zero() -> None:
    assert [shown(METRICS["psnr"], value, sign=True) for value in (1.5, -1.5, 0.001, -0.001)] == [
        *("+1.50", "-1.50", "0.00", "0.00")
    ]


def test_one_seed_has_no_spread() -> None:
    assert shown_with_spread(METRICS["psnr"], 20.13, 0.05) == "20.13 ± 0.05"
    assert shown_with_spread(METRICS["psnr"], 20.13, None) == "20.13"
    assert shown_with_spread(METRICS["psnr"], None, 0.05) == NO_FIGURE


def test_programs_read_stored_units() -> None:
    assert stored("peak_memory_bytes", 3 * 2**20) == "3145728"
    assert (stored("psnr", None), stored("psnr", math.nan, "-")) == ("", "-")


def test_labels_have_unit_and_direction() -> None:
    assert label(METRICS["peak_memory_bytes"]) == "Peak memory (MiB) ↓"
    assert label(METRICS["psnr"]) == "PSNR (dB) ↑"
    assert label(METRICS["mu_d"]) == "μ_D"
    assert label(METRICS["psnr"], arrow=False) == "PSNR (dB)"


def test_a_figure_that_is_missing_has_no_mark() -> None:
    assert filter_mark(METRICS["miou"], True, 0.5)
    assert not filter_mark(METRICS["miou"], True, math.nan)
