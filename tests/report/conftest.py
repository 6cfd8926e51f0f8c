"""Results made by hand, for tables and charts."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path

import pytest

from splashbench.score.metrics import METRICS
from splashbench.score.result import Digests, Result, metric_value
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
