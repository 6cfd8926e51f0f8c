"""What machine a figure was measured on: part of every submission, since costs mean nothing without it."""

from __future__ import annotations

import os
import platform
from pathlib import Path


def describe(device: str = "cpu") -> dict[str, str | int | float]:
    """Processor, cores this process may use, memory, operating system and Python of this machine; the GPU where
    `device` is "cuda", so that what it measures stands apart from what processors do."""
    import psutil

    affinity = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    # Code with a PyTorch of its own may see a card that this one does not.
    gpu = (_gpu_name(device) or device) if device.startswith("cuda") else None
    return {
        **({"gpu": gpu} if gpu else {}),
        "cpu": _cpu_name(),
        "cores": affinity,
        "memory_gib": round(psutil.virtual_memory().total / 2**30, 1),
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
    }


def _gpu_name(device: str) -> str | None:
    import torch

    return torch.cuda.get_device_name(device) if torch.cuda.is_available() else None


def _cpu_name() -> str:
    try:
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()
