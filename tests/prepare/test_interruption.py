"""A preparation killed at random moments and started again gives the same scene, byte for byte.

Slow: every moment costs a whole preparation. SPLASHBENCH_KILLS sets how many moments are tried (default 3).
"""

from __future__ import annotations

import os
import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from splashbench.cli.main import main

pytestmark = pytest.mark.slow


def prepare(session: Path, scene: Path, work: Path) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-m", "splashbench", "prepare", str(session), str(scene), "--work", str(work)]
    return subprocess.Popen(
        [*command, "--timesteps", "12"], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, env=dict(os.environ)
    )


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def test_killed_and_started_again(tmp_path: Path) -> None:
    session = tmp_path / "session"
    small = ["--size", "320x180", "--fps", "30", "--particle-radius", "0.004"]
    assert main(["synth", "session", str(session), *small]) == 0
    began = time.perf_counter()
    assert prepare(session, tmp_path / "undisturbed", tmp_path / "work").wait() == 0
    seconds = time.perf_counter() - began
    expected = contents(tmp_path / "undisturbed")
    assert len(expected) > 7 * 12

    moments = random.Random(0)
    killed_in = []
    for number in range(int(os.environ.get("SPLASHBENCH_KILLS", "3"))):
        shutil.rmtree(tmp_path / "work")
        process = prepare(session, tmp_path / "scene", tmp_path / "work")
        moment = moments.random() * seconds
        time.sleep(moment)
        process.send_signal(signal.SIGKILL)
        process.wait()
        stages = sorted(path.stem for path in (tmp_path / "work").glob("*.json"))
        killed_in.append(f"{moment:.1f} s, after {', '.join(stages) or 'nothing'}")
        print(killed_in[-1], "of", f"{seconds:.1f} s", flush=True)
        if (tmp_path / "scene").exists():  # it was faster this time
            shutil.rmtree(tmp_path / "scene")
        assert prepare(session, tmp_path / "scene", tmp_path / "work").wait() == 0
        assert contents(tmp_path / "scene") == expected, f"killed number {number} ({killed_in[-1]})"
        shutil.rmtree(tmp_path / "scene")
        assert [path.name for path in tmp_path.iterdir() if path.name.startswith(".tmp-")] == []
