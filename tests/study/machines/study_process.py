"""What several tests of studies share: specs, a study as a process of its own, and what is left of it."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import psutil

from splashbench import toml

METHOD = f"{Path(__file__).with_name('misbehaving_methods.py')}:Misbehaving"
#: Of a result, what is measured anew in every run.
_MEASURED = ("fit_seconds", "peak_memory_bytes", "peak_device_memory_bytes", "render_fps")


def write_spec(folder: Path, scene: Path, **changes: Any) -> str:
    spec = {
        "name": "misbehaving",
        "method": METHOD,
        "seeds": [0],
        "scenes": [str(scene)],
        "metrics": ["psnr"],
        "baseline": "full",
        "reference": False,
        "variants": [{"name": "full"}],
        **changes,
    }
    path = folder / "study.toml"
    path.write_text(toml.dumps(spec))
    return str(path)


def start_study(spec: str, out: Path, *words: str, **environment: str) -> subprocess.Popen:
    """`splashbench study run` as a process; its lines for the user go to OUT.said."""
    command = [sys.executable, "-m", "splashbench", "study", "run", spec, str(out), *words]
    with out.with_suffix(".said").open("ab") as said:
        return subprocess.Popen(command, stderr=said, stdout=said, env={**os.environ, **environment})


def study(spec: str, out: Path, *words: str, **environment: str) -> tuple[int, str]:
    """Run a study to its end: exit code, and what it said."""
    code = start_study(spec, out, *words, **environment).wait(timeout=600)
    return code, out.with_suffix(".said").read_text()


def entries(out: Path) -> dict[str, dict[str, Any]]:
    """The entry of each run, by its title without the digest."""
    found = [json.loads(path.read_text()) for path in (out / "runs").glob("*.json")]
    return {entry["title"].rpartition("__")[0]: entry for entry in found}


def deterministic_results(out: Path) -> dict[str, bytes]:
    """The bytes of each result without what is measured anew in every run, by method, scene and seed."""
    found = {}
    for path in (out / "results").glob("*.json"):
        result = json.loads(path.read_text())
        for name in _MEASURED:
            result["metrics"].pop(name, None)
        del result["digests"]["submission"]
        key = path.stem.rpartition("__")[0] + str(sorted(result["settings"].items()))
        assert key not in found, f"{path} counts twice"
        found[key] = json.dumps(result).encode()
    return found


def running(text: str) -> list[str]:
    """Command lines with `text`, of other processes than this one."""
    found = []
    for process in psutil.process_iter():
        try:
            line = " ".join(process.cmdline())
            if text in line and process.pid != os.getpid() and process.status() != psutil.STATUS_ZOMBIE:
                found.append(line)
        except psutil.Error:
            continue
    return found


def marked(mark: str) -> list[str]:
    """Processes with `mark` in their environment, other than this one."""
    found = []
    for process in psutil.process_iter():
        try:
            if mark in process.environ().values() and process.pid != os.getpid():
                found.append(" ".join(process.cmdline()))
        except (psutil.Error, OSError):
            continue
    return found


def wait_for(condition: Callable[[], bool], seconds: float = 180.0) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.1)
