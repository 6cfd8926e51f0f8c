"""A Ray cluster of two machines, both of them this one: one is killed, joins late, or does not see the files."""

from __future__ import annotations

import os
import subprocess
import sys
import uuid
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest
from study_process import deterministic_results, entries, marked, start_study, study, wait_for, write_spec

pytest.importorskip("ray", reason="comes with the extra [cluster]")
pytestmark = pytest.mark.slow

_RAY = [sys.executable, "-m", "ray.scripts.scripts"]


class Cluster:
    """Ray's own processes, started as a user does it; each machine has one core and a mark of its own."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.marks: list[str] = []
        # Without what the tests have set: Ray's processes on another machine would not have it either.
        self._environment = {**os.environ, "RAY_USAGE_STATS_ENABLED": "0", "RAY_TMPDIR": str(folder)}
        said = self._start("--head", "--port=0", f"--temp-dir={folder}", "--include-dashboard=false")
        marker = "--address='"
        self.address = said[said.index(marker) + len(marker) :].partition("'")[0]

    def _start(self, *words: str, before: tuple[str, ...] = ()) -> str:
        mark = uuid.uuid4().hex
        environment = {**self._environment, "TEST_MACHINE": mark}
        command = [*before, *_RAY, "start", "--num-cpus=1", "--disable-usage-stats", *words]
        ended = subprocess.run(command, env=environment, capture_output=True, text=True, check=False, timeout=120)
        assert ended.returncode == 0, ended.stdout + ended.stderr
        self.marks.append(mark)
        return ended.stdout

    def join(self, *words: str, before: tuple[str, ...] = ()) -> None:
        """Start another machine. words: more of Ray's options. before: words in front of the command."""
        self._start(f"--address={self.address}", *words, before=before)

    def processes(self, machine: int) -> list[psutil.Process]:
        found = []
        for process in psutil.process_iter():
            try:
                if process.environ().get("TEST_MACHINE") == self.marks[machine]:
                    found.append(process)
            except (psutil.Error, OSError):
                continue
        return found

    def kill(self, machine: int) -> None:
        """Cut the power: Ray and whatever runs there ends at once."""
        for process in self.processes(machine):
            process.kill()

    def stop(self) -> None:
        for machine in range(len(self.marks)):
            self.kill(machine)


@pytest.fixture
def cluster(monkeypatch: pytest.MonkeyPatch) -> Iterator[Cluster]:
    import tempfile

    # Open to nobody else meanwhile.
    monkeypatch.setenv("RAY_AUTH_MODE", "token")
    monkeypatch.setenv("RAY_AUTH_TOKEN", uuid.uuid4().hex)

    # Not pytest's folder: the names of Ray's sockets may have 107 letters.
    with tempfile.TemporaryDirectory(prefix="ray", ignore_cleanup_errors=True) as folder:
        cluster = Cluster(Path(folder))
        try:
            yield cluster
        finally:
            cluster.stop()


def test_a_machine_that_is_killed_loses_no_run_and_none_counts_twice(
    cluster: Cluster, balls_directory: Path, tmp_path: Path
) -> None:
    cluster.join()
    mark, log, out = uuid.uuid4().hex, tmp_path / "log", tmp_path / "out"
    seeds = list(range(8))
    spec = write_spec(tmp_path, balls_directory, seeds=seeds, base={"log": str(log), "seconds": 3.0})
    place = ["--on", f"ray://{cluster.address}"]
    process = start_study(spec, out, *place, "--keep", SPLASHBENCH_TEST_MARK=mark)
    wait_for(lambda: len(_ended(out)) >= 2)
    # Both machines are in a fit, of three seconds.
    wait_for(lambda: len(log.read_text().splitlines()) >= len(_ended(out)) + 2)
    cluster.kill(1)
    assert process.wait(timeout=600) == 0, out.with_suffix(".said").read_text()
    said = out.with_suffix(".said").read_text()
    assert "Ray: 2 machines, 2 at once, each with 1 core" in said
    assert "lost: " in said
    assert "it is made again" in said
    found = entries(out)
    assert [entry["status"] for entry in found.values()] == ["ok"] * len(seeds)
    assert len(list((out / "results").iterdir())) == len(seeds)
    assert len(log.read_text().splitlines()) > len(seeds)  # what was lost was fitted twice, and counts once
    wait_for(lambda: not [line for line in marked(mark) if "raylet" not in line], seconds=60)
    code, said = study(spec, tmp_path / "alone", "--keep")
    assert code == 0, said
    assert deterministic_results(out) == deterministic_results(tmp_path / "alone")
    assert (out / "table.csv").read_bytes() == (tmp_path / "alone" / "table.csv").read_bytes()
    renders = [path.relative_to(out) for path in (out / "submissions").glob("*/renders/*/*.png")]
    assert len(renders) > len(seeds)
    assert all((out / path).read_bytes() == (tmp_path / "alone" / path).read_bytes() for path in renders)


def _ended(out: Path) -> list[Path]:
    return list((out / "runs").glob("*.json"))


def _alive(processes: list[psutil.Process]) -> list[psutil.Process]:
    return [process for process in processes if process.is_running() and process.status() != psutil.STATUS_ZOMBIE]


def test_a_machine_that_joins_takes_part(cluster: Cluster, balls_directory: Path, tmp_path: Path) -> None:
    spec = write_spec(tmp_path, balls_directory, seeds=list(range(6)), base={"seconds": 3.0})
    process = start_study(spec, tmp_path / "out", "--on", f"ray://{cluster.address}")
    wait_for(lambda: "run 1 of 6" in (tmp_path / "out.said").read_text())
    cluster.join()
    wait_for(lambda: any("keeper" in " ".join(each.cmdline()) for each in _alive(cluster.processes(1))))
    assert process.wait(timeout=600) == 0
    assert [entry["status"] for entry in entries(tmp_path / "out").values()] == ["ok"] * 6


def test_a_machine_that_does_not_see_the_folder_is_named(
    cluster: Cluster, balls_directory: Path, tmp_path: Path
) -> None:
    (tmp_path / "place").mkdir()
    hide = f'mount -t tmpfs tmpfs {tmp_path / "place"} && exec "$@"'
    try:
        cluster.join(before=("unshare", "-m", "sh", "-c", hide, "sh"))
    except AssertionError as error:
        pytest.skip(f"no folder can be hidden from a process here: {error}")
    spec = write_spec(tmp_path, balls_directory)
    code, said = study(spec, tmp_path / "place" / "out", "--on", f"ray://{cluster.address}")
    assert code == 1
    error = [line for line in said.splitlines() if line.startswith("error: ")]
    assert len(error) == 1
    assert f"does not see {tmp_path / 'place' / 'out' / 'cache'}; put it on a file system that every" in error[0]


def test_a_gpu_is_given_to_methods_that_can_use_one(cluster: Cluster, balls_directory: Path, tmp_path: Path) -> None:
    """Ray counts a GPU that this machine need not have, and tells work which one it has."""
    methods = Path(__file__).parents[1] / "study_methods.py"
    variants = [{"name": "full", "method": f"{methods}:Accelerated"}, {"name": "grey", "method": f"{methods}:Grey"}]
    spec = write_spec(tmp_path, balls_directory, method=f"{methods}:Grey", variants=variants, device="auto")
    place = ["--on", f"ray://{cluster.address}"]
    assert study(spec, tmp_path / "none", *place)[0] == 0
    assert _gpus(tmp_path / "none") == {"full": "none", "grey": None}
    cluster.join("--num-gpus=1")
    code, said = study(spec, tmp_path / "one", *place, SPLASHBENCH_TEST_GPU="1")
    assert code == 0, said
    assert _gpus(tmp_path / "one") == {"full": "0", "grey": None}


def _gpus(out: Path) -> dict[str, str | None]:
    """What each run notes of the GPUs that it sees."""
    return {title.split("__")[1]: entry["record"]["notes"].get("gpus") for title, entry in entries(out).items()}


def test_work_that_no_machine_has_room_for_is_refused(cluster: Cluster, balls_directory: Path, tmp_path: Path) -> None:
    spec = write_spec(tmp_path, balls_directory)
    code, said = study(spec, tmp_path / "out", "--on", f"ray://{cluster.address}", "--cores", "64")
    assert code == 1
    assert "error: no machine of the Ray cluster has 64 cores; give smaller --cores" in said


def test_a_cluster_that_is_not_there_is_one_line(balls_directory: Path, tmp_path: Path) -> None:
    spec = write_spec(tmp_path, balls_directory)
    code, said = study(spec, tmp_path / "out", "--on", "ray://127.0.0.1:9", "--json")
    assert code == 1
    assert "error: no Ray cluster answers at 127.0.0.1:9" in said
    assert "Traceback" not in said
    assert said.count("error: ") == 1
