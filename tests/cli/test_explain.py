"""`splashbench explain`: the finding, then what was tried, bought and refused; strangers' text comes out harmless."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any
from xml.dom import minidom

import numpy as np
import pytest

from splashbench.cli.main import main
from splashbench.files import read_image
from splashbench.submission import Decision, Identity, Record, Rung, Status, seal

Fails = Callable[..., str]
Explain = Callable[..., str]
HOSTILE = "\x1b[31m\nerror: \u202e</script><b>&amp; $\\frac{x}$ "


def iterations() -> Decision:
    """Three rungs on withheld photographs, the last one refused."""
    return Decision(
        name="iterations",
        basis="withheld",
        chosen="1000 iterations",
        because="2000 gain less than two standard errors",
        measure="PSNR (dB)",
        rungs=[
            Rung(value="500 iterations", bought=True, quality=26.1),
            Rung(value="1000 iterations", bought=True, quality=27.9, gain=1.8, standard_error=0.12, seconds=25.0),
            Rung(
                value="2000 iterations",
                bought=False,
                quality=27.93,
                gain=0.03,
                standard_error=0.08,
                seconds=75.0,
                bytes=410_000.0,
                reason="within its error",
            ),
        ],
    )


def hostile(n_decisions: int = 50, n_rungs: int = 40) -> list[Decision]:
    """As many decisions and rungs as a record may have, with the worst texts and figures."""
    rungs = [
        Rung(
            value=(HOSTILE * 5)[:100],
            bought=bool(n % 2),
            quality=1e15 * (-1) ** n,
            gain=-1e15,
            standard_error=1e15,
            seconds=1e15,
            bytes=-1e15,
            reason=(HOSTILE * 20)[:500],
        )
        for n in range(n_rungs)
    ]
    return [
        Decision(
            name=HOSTILE[:60],
            basis="tolerance",
            chosen=(HOSTILE * 5)[:100],
            because=(HOSTILE * 20)[:500],
            measure=(HOSTILE * 5)[:100],
            rungs=rungs,
        )
        for _ in range(n_decisions)
    ]


def write(directory: Path, scene: str = "bowl", **fields: Any) -> Path:
    directory.mkdir()
    costs = {"fit_seconds": 200.0, "storage_bytes": 3_210_000, "peak_memory_bytes": 512 << 20}
    seal(directory, Identity(method="alpha", scene=scene, scene_digest="0" * 64), Record(**{**costs, **fields}))
    return directory


@pytest.fixture
def place(tmp_path: Path) -> Path:
    return tmp_path / "submission"


@pytest.fixture
def explain(capsys: pytest.CaptureFixture[str]) -> Explain:
    """What the command prints for people; it must not fail."""

    def run(*words: object) -> str:
        capsys.readouterr()
        assert main(["explain", *map(str, words)]) == 0
        return capsys.readouterr().err

    return run


def test_the_finding_comes_first_then_decisions_stages_and_notes(place: Path, explain: Explain) -> None:
    write(place, decisions=[iterations()], stages={"short": 20.0, "long": 150.0}, notes={"container": "a basin"})
    assert explain(place).splitlines() == [
        "alpha (best, seed 0) on bowl: fit 3.33 min, 3.21 MB of storage, 512 MiB of memory, 1 decision",
        "3 rungs: 2 bought, 1 refused; decided by withheld photographs 1",
        "",
        "1. iterations: 1000 iterations",
        "   withheld photographs: 2000 gain less than two standard errors",
        "     value            PSNR (dB)     gain ± s.e.       time     size",
        "     500 iterations       26.10               –          –        –  bought",
        "   * 1000 iterations      27.90    +1.80 ± 0.12      +25 s        –  bought",
        "     2000 iterations      27.93  +0.030 ± 0.080  +1.25 min  +410 kB  refused: within its error",
        "",
        "stage     time  of the fit",
        "long   2.5 min         75%",
        "short     20 s         10%",
        "",
        "notes",
        "container: a basin",
    ]


def test_a_submission_without_decisions_says_so_and_shows_the_rest(place: Path, explain: Explain) -> None:
    write(place, stages={"fit": 9.0}, notes={"clocks": "as told"})
    printed = explain(place)
    assert "no decision is recorded" in printed
    assert "fit     9 s" in printed
    assert "clocks: as told" in printed


def test_a_failed_run_shows_its_status_and_reason(place: Path, explain: Explain) -> None:
    write(place, status=Status.OUT_OF_MEMORY, reason="killed\nof 8 GiB", fit_seconds=None, storage_bytes=None)
    first, second, _ = explain(place).splitlines()
    assert first == "alpha (best, seed 0) on bowl: 512 MiB of memory, 0 decisions"
    assert second == "the run ended with status out_of_memory: killed of 8 GiB"


def test_json_holds_the_record_and_what_was_drawn(
    place: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write(place, decisions=[iterations()] * 14, stages={"fit": 9.0})
    out = tmp_path / "chart.svg"
    assert main(["explain", str(place), "--json", "--out", str(out)]) == 0
    found = json.loads(capsys.readouterr().out)
    assert [Decision.model_validate(each) for each in found["decisions"]] == [iterations()] * 14
    assert (found["method"], found["scene"], found["status"], found["fit_seconds"]) == ("alpha", "bowl", "ok", 200.0)
    assert (found["stages"], found["file"], found["decisions_not_drawn"]) == ({"fit": 9.0}, str(out), 2)


def test_hostile_text_is_harmless_and_bounded(place: Path, tmp_path: Path, explain: Explain) -> None:
    worst = HOSTILE * 1000
    write(
        place,
        scene=worst[:1000],
        decisions=hostile(),
        stages={f"{worst}{n}": 1e15 for n in range(1000)},
        notes={worst: (HOSTILE * 20)[:500]},
        reason=worst,
        status=Status.CRASHED,
    )
    printed = explain(place, "--out", tmp_path / "chart.svg")
    lines = printed.splitlines()
    assert all(line.isprintable() for line in lines)
    assert not any(line.startswith("error:") for line in lines)
    assert max(map(len, lines)) < 700
    assert len(lines) < 50 * (40 + 16) + 100
    assert "and 970 shorter stages" in printed
    # The picture has the text in comments, beside its outlines.
    document = (tmp_path / "chart.svg").read_text(encoding="utf-8")
    minidom.parseString(document)
    assert "<b>" not in document.replace("<!--", "\0").split("\0")[0]
    assert "\x1b" not in document
    assert "\u202e" not in document


@pytest.mark.parametrize("name", ["chart.png", "chart.SVG"])
def test_a_picture_is_written_whole(name: str, place: Path, tmp_path: Path, explain: Explain) -> None:
    write(place, decisions=[iterations()])
    out = tmp_path / "pictures" / name
    assert f"wrote {out}" in explain(place, "--out", out)
    assert _names(out.parent) == [name]
    if name.endswith("png"):
        pixels = read_image(out)
        assert pixels.shape[0] > 400
        assert np.unique(pixels.reshape(-1, 3), axis=0).shape[0] > 50
    else:
        assert minidom.parse(str(out)).documentElement.tagName == "svg"
    first = out.read_bytes()
    explain(place, "--out", out)
    assert out.read_bytes() == first


def test_a_picture_that_fails_leaves_the_old_one(
    place: Path, tmp_path: Path, fails: Fails, monkeypatch: pytest.MonkeyPatch
) -> None:
    from matplotlib.figure import Figure

    def full(figure: Figure, target: Path, **_: object) -> None:
        Path(target).write_bytes(b"half")
        raise OSError(28, "No space left on device")

    write(place, decisions=[iterations()])
    out = tmp_path / "chart.png"
    out.write_bytes(b"old")
    monkeypatch.setattr(Figure, "savefig", full)
    assert "the disk is full" in fails("explain", place, "--out", out)
    assert out.read_bytes() == b"old"
    assert _names(tmp_path) == ["chart.png", "submission"]


def test_what_cannot_be_drawn_is_one_line(place: Path, tmp_path: Path, fails: Fails) -> None:
    write(place)
    assert "chart.pdf is neither .png nor .svg" in fails("explain", place, "--out", tmp_path / "chart.pdf")
    assert "there is no decision to draw" in fails("explain", place, "--out", tmp_path / "chart.png")
    # It would be a file that SHA256SUMS does not list.
    assert "whose files are sealed" in fails("explain", place, "--out", place / "chart.png")
    assert "chart.png is a folder" in fails("explain", place, "--out", _folder(tmp_path / "chart.png"))
    assert _names(place) == ["SHA256SUMS", "record.json", "submission.toml"]


def _names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def _folder(path: Path) -> Path:
    path.mkdir()
    return path


def test_what_is_no_submission_is_one_line(place: Path, tmp_path: Path, fails: Fails) -> None:
    assert "is no submission" in fails("explain", tmp_path)
    write(place, decisions=[iterations()])
    record = place / "record.json"
    whole = record.read_text()
    for damaged, message in (
        (whole[:-20], "cannot be read as JSON"),
        (whole.replace("26.1", "NaN"), "decisions.0.rungs.0.quality"),
        (whole.replace('"withheld"', '"guess"'), "decisions.0.basis"),
        ("[" * 100_000, "cannot be read as JSON"),
        ("[]", "record.json: "),
    ):
        record.write_text(damaged)
        assert message in fails("explain", place)
    record.unlink()
    assert "record.json does not exist" in fails("explain", place)
