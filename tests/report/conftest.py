"""Results made by hand, for tables and charts."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from splashbench.report.page import leaderboard_page
from splashbench.report.results import load_results
from splashbench.report.table import leaderboard_table
from splashbench.score.metrics import METRICS
from splashbench.score.result import CheckpointScore, Digests, Result, metric_value
from splashbench.score.settings import PROTOCOL_V1

MakeResult = Callable[..., Result]


def make(
    method: str = "alpha",
    seed: int = 0,
    scene: str = "bowl",
    status: str = "ok",
    reason: str = "",
    cpu: str = "test processor",
    **more: object,
) -> Result:
    """A result; metrics by name, other fields of `Result` by theirs."""
    values = {name: value for name, value in more.items() if name in METRICS}
    fields = {name: value for name, value in more.items() if name not in METRICS}
    submission = hashlib.sha256(f"{method} {scene} {status} {seed} {cpu}".encode()).hexdigest()
    return Result(
        **{
            "method": method,
            "method_version": "1",
            "scene": scene,
            "seed": seed,
            "preset": "best",
            "status": status,
            "reason": reason,
            "protocol": PROTOCOL_V1,
            "digests": Digests(scene=scene.ljust(64, "0"), submission=submission, protocol=PROTOCOL_V1.digest),
            "metrics": {name: metric_value(name, values.get(name), "not measured") for name in METRICS},
            "hardware": {"cpu": cpu, "cores": 2},
            **fields,
        }
    )


@pytest.fixture
def make_result() -> MakeResult:
    return make


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Results of two methods over two scenes and three seeds, three controls, and a failed run."""
    directory = tmp_path / "results"
    for s, scene in enumerate(("bowl", "tank")):
        for seed in range(3):
            wobble = 0.1 * seed + 0.7 * s
            make(
                "alpha",
                seed,
                scene,
                psnr=20.0 - wobble,
                dpsnr_bg=2.5 - wobble,
                lpips=0.05 + 0.01 * wobble,
                ssim=0.95,
                miou=0.8,
                fit_seconds=90.0 + 9 * seed,
                peak_memory_bytes=1.5 * 2**30,
            ).save(directory)
            make(
                "beta",
                seed,
                scene,
                psnr=18.0 + wobble,
                dpsnr_bg=0.5 + wobble,
                lpips=0.09 - 0.01 * wobble,
                ssim=0.93,
                miou=0.6,
                fit_seconds=1500.0 + 40 * seed,
                peak_memory_bytes=6 * 2**30,
            ).save(directory)
        make("nothing", 0, scene, control=True, psnr=17.5, dpsnr_bg=0.0, lpips=0.11, fit_seconds=3.0).save(directory)
        make("oracle", 0, scene, control=True, psnr=100.0, dpsnr_bg=82.5, lpips=0.0).save(directory)
    make("gamma", 0, "bowl", "out_of_memory", "killed (signal 9) | of 8 GiB").save(directory)
    return directory


def course_of(*states: tuple[float, float]) -> tuple[CheckpointScore, ...]:
    """Checkpoints at (seconds, PSNR)."""
    return tuple(
        CheckpointScore(seconds=s, metrics={"psnr": psnr, "lpips": 1 / psnr, "miou": psnr / 40}) for s, psnr in states
    )


@pytest.fixture
def course() -> Callable[..., tuple[CheckpointScore, ...]]:
    return course_of


@pytest.fixture
def results(make_result: MakeResult, tmp_path: Path) -> Path:
    """Three methods and `nothing` on two scenes with two seeds, a failed run, and one on another machine."""
    directory = tmp_path / "results"
    figures: dict[str, Any] = {"lpips": 0.05, "miou": 0.7, "peak_memory_bytes": 2.0**30, "storage_bytes": 3e6}
    for s, scene in enumerate(("bowl", "tank")):
        for seed in range(2):
            shift = s + 0.1 * seed
            for method, psnr, seconds, states in (
                ("fast", 22.0, 9.0, course_of((5.1, 20.0 + shift))),
                ("good", 28.0, 80.0, course_of((6.0, 15.0), (11.0, 24.0 + shift), (41.0, 27.0 + shift))),
                ("slow", 26.0, 300.0, course_of((41.0, 21.0), (170.0, 25.0))),
            ):
                make_result(
                    method,
                    seed,
                    scene,
                    psnr=psnr + shift,
                    fit_seconds=seconds,
                    checkpoints=states,
                    told=("times",),
                    stages={"fit": seconds - 1, "rest": 1.0},
                    overrides=("iterations=7",) if method == "fast" else (),
                    **{**figures, "storage_bytes": 1e6 * seconds},
                ).save(directory)
        make_result("nothing", 0, scene, control=True, psnr=12.0, fit_seconds=3.0, told=("times",)).save(directory)
    make_result("broken", 0, "bowl", status="crashed", reason="no memory", told=("times",)).save(directory)
    make_result("good", 0, "bowl", cpu="another", psnr=50.0, fit_seconds=1.0, told=("times",), **figures).save(
        directory
    )
    return directory


@pytest.fixture
def page_of() -> Callable[..., str]:
    """The leaderboard's page of a folder of results."""

    def make_page(results: Path, with_paper: bool = False) -> str:
        sources = load_results(results)
        return leaderboard_page(leaderboard_table(sources), sources, with_paper)

    return make_page


@pytest.fixture
def data_of() -> Callable[[str], dict[str, Any]]:
    """The data that a page holds."""

    def read(page: str) -> dict[str, Any]:
        found = re.search(r'<script type="application/json" id="data">(.*?)</script>', page, re.DOTALL)
        assert found is not None
        data: dict[str, Any] = json.loads(found[1])
        return data

    return read
