"""What a run's device is: asked for, refused, or chosen."""

from __future__ import annotations

import pytest

from splashbench.errors import SplashbenchError
from splashbench.harness import hardware
from splashbench.harness.devices import chosen_device
from splashbench.harness.discovery import load_method
from splashbench.render import cuda


@pytest.fixture(params=[True, False], ids=["gpu", "no gpu"])
def gpu(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> bool:
    monkeypatch.setattr(cuda, "available", lambda: None if request.param else "PyTorch sees no CUDA device; get one")
    return bool(request.param)


def test_auto_takes_a_gpu_where_method_and_machine_have_one(gpu: bool) -> None:
    assert chosen_device(load_method("scaffold_4d"), "auto") == ("cuda" if gpu else "cpu")
    assert chosen_device(load_method("hull_points"), "auto") == "cpu"


def test_what_is_asked_for_is_taken_or_refused(gpu: bool) -> None:
    method = load_method("spacetime_gaussians")
    assert chosen_device(method, "cpu") == "cpu"
    if gpu:
        assert chosen_device(method, "cuda") == "cuda"
    else:
        with pytest.raises(SplashbenchError, match="cannot run on cuda here: PyTorch sees no CUDA device; get one"):
            chosen_device(method, "cuda")


def test_what_the_method_does_not_run_on_is_refused() -> None:
    with pytest.raises(SplashbenchError, match="hull_points runs on cpu, not on 'cuda'; leave the device out"):
        chosen_device(load_method("hull_points"), "cuda")


def test_the_machine_names_its_gpu_where_one_is_used(monkeypatch: pytest.MonkeyPatch) -> None:
    import torch

    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda device: f"NVIDIA Example at {device}")
    assert hardware.describe("cuda:1")["gpu"] == "NVIDIA Example at cuda:1"
    assert "gpu" not in hardware.describe()
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert hardware.describe("cuda:1")["gpu"] == "cuda:1"
