"""How runs are spread: what each needs of a machine, which go before others, and what the user is told meanwhile."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from splashbench.cluster.work import Ended, Needs, Work
from splashbench.errors import SplashbenchError
from splashbench.files import read_model, write_model
from splashbench.study import execution
from splashbench.study.execution import ExecutionOptions, carry_out_plan
from splashbench.study.job import Attempt, Job, RunEntry
from splashbench.study.plan import StudyPlan, make_plan
from splashbench.study.spec import StudySpec

METHODS = Path(__file__).with_name("study_methods.py")


@dataclass
class Place:
    """Workers of `cores` cores and `gpus` GPUs on one machine, who end a run when they are waited for, and make none.

    started: the title and the needs of each run. silent: how often nothing has ended yet before something does.
    """

    cores: int
    gpus: int
    silent: int = 0
    started: list[tuple[str, Needs]] = field(default_factory=list)
    running: list[Work] = field(default_factory=list)

    def __enter__(self) -> Place:
        return self

    def __exit__(self, *of_error: object) -> None: ...

    def room(self, needs: Needs) -> int:
        gpus = self.gpus - sum(work.needs.gpus for work in self.running)
        cores = self.cores - len(self.running)
        return min(cores, gpus // needs.gpus) if needs.gpus else cores

    def sharing(self, needs: Needs) -> int:
        return self.cores

    def start(self, work: Work) -> None:
        assert self.room(work.needs) > 0
        self.started.append((json.loads(work.file.read_text())["title"].split("__")[1], work.needs))
        self.running.append(work)
        work.log.parent.mkdir(exist_ok=True)
        work.log.write_text("Grey: 10% beginning\nGrey: 40% \x1b[31mappearance\n")

    def wait(self) -> list[Ended]:
        if self.silent or not self.running:
            self.silent = max(0, self.silent - 1)
            return []
        # The last one first: those that need a GPU, started before, are still at it.
        work = self.running.pop()
        job = read_model(work.file, Job)
        entry = RunEntry(digest=job.digest, title=job.title, status="ok", attempt=Path(job.attempt).name)
        write_model(Attempt(Path(job.attempt)).entry, entry)
        return [Ended(work.key)]


@pytest.fixture
def place(monkeypatch: pytest.MonkeyPatch) -> Place:
    found = Place(cores=3, gpus=1)
    monkeypatch.setattr(execution, "workers_at", lambda *_, **__: found)
    return found


def plan(balls: Path, device: str, gpu_elsewhere: bool | None = True, **changes: Any) -> StudyPlan:
    """Three runs of a method that can use a GPU, then three of one that cannot."""
    spec = {
        "name": "spread",
        "method": f"{METHODS}:Grey",
        "seeds": [0],
        "scenes": [str(balls)],
        "metrics": ["psnr"],
        "baseline": "a",
        "reference": False,
        "device": device,
        "variants": [
            *(
                {"name": name, "method": f"{METHODS}:Accelerated", "settings": {"grey": 0.1 * i}}
                for i, name in enumerate("abc")
            ),
            *({"name": name, "settings": {"grey": 0.1 * i}} for i, name in enumerate("def")),
        ],
        **changes,
    }
    return make_plan(StudySpec.model_validate(spec), gpu_elsewhere)


def test_a_gpu_is_kept_for_methods_that_can_use_one(balls_directory: Path, tmp_path: Path, place: Place) -> None:
    tally = carry_out_plan(plan(balls_directory, "auto"), tmp_path / "out", ExecutionOptions(on="ray", jobs=None))
    assert tally.made == 6
    gpus = {name: needs.gpus for name, needs in place.started}
    assert gpus == {"a": 1, "b": 1, "c": 1, "d": 0, "e": 0, "f": 0}
    # One GPU: `b` and `c` wait for it, and those that need none go before.
    assert [name for name, _ in place.started][:3] == ["a", "d", "e"]


@pytest.mark.parametrize(
    ("there", "asked", "expected"), [(False, None, 0), (False, 2, 0), (True, None, 1), (True, 2, 2), (True, 0, 0)]
)
def test_how_many_gpus_a_run_has(
    balls_directory: Path, tmp_path: Path, place: Place, there: bool, asked: int | None, expected: int
) -> None:
    place.gpus = 4
    said: list[str] = []
    options = ExecutionOptions(on="ray", jobs=None, gpus=asked, tell=said.append)
    carry_out_plan(plan(balls_directory, "auto", there), tmp_path / "out", options)
    assert any("--gpus does nothing here" in line for line in said) is (asked == 2 and not there)
    assert {needs.gpus for name, needs in place.started if name in "abc"} == {expected}
    assert {needs.gpus for name, needs in place.started if name in "def"} == {0}


def test_the_processor_needs_no_gpu(balls_directory: Path, tmp_path: Path, place: Place) -> None:
    carry_out_plan(plan(balls_directory, "cpu"), tmp_path / "out", ExecutionOptions(on="ray", jobs=None, gpus=2))
    assert {needs.gpus for _, needs in place.started} == {0}
    assert [name for name, _ in place.started][:3] == ["a", "b", "c"]


def test_an_order_is_asked_for_no_run_too_many(balls_directory: Path, tmp_path: Path, place: Place) -> None:
    """What it gives next depends on what has ended; no kind of study that has one uses a GPU."""
    ended: list[int] = []
    out = tmp_path / "out"

    def order(missing: Any) -> Iterator[Any]:
        for run in missing:
            ended.append(len(list((out / "runs").glob("*.json"))))
            yield run

    carry_out_plan(plan(balls_directory, "cpu"), out, ExecutionOptions(on="ray", jobs=None, order=order))
    assert ended == [0, 0, 0, 1, 2, 3]
    assert len(place.started) == 6


def test_auto_means_what_the_machines_have(balls_directory: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def found(gpu_elsewhere: bool | None) -> list[str]:
        return [run.device for run in plan(balls_directory, "auto", gpu_elsewhere).runs]

    assert found(True) == ["cuda"] * 3 + ["cpu"] * 3
    assert found(False) == found(None) == ["cpu"] * 6
    monkeypatch.setenv("SPLASHBENCH_TEST_GPU", "1")
    assert found(None) == ["cuda"] * 3 + ["cpu"] * 3
    assert found(False) == ["cpu"] * 6


def test_a_device_that_was_found_and_one_that_was_named_are_the_same_runs(balls_directory: Path) -> None:
    """What was made here is not made again on a cluster, nor the other way round."""

    def digests(device: str, gpu_elsewhere: bool | None) -> list[str]:
        return [run.digest for run in plan(balls_directory, device, gpu_elsewhere).runs]

    assert digests("auto", None) == digests("auto", False) == digests("cpu", None) == digests("cpu", True)
    assert digests("auto", True)[3:] == digests("cpu", None)[3:]
    assert digests("auto", True)[0] != digests("cpu", None)[0]


def test_a_gpu_may_be_elsewhere(balls_directory: Path) -> None:
    variants = [{"name": "a", "method": f"{METHODS}:Accelerated"}]
    assert [run.device for run in plan(balls_directory, "cuda", False, variants=variants).runs] == ["cuda"]
    with pytest.raises(SplashbenchError, match="cannot run on cuda here: there is none"):
        plan(balls_directory, "cuda", None, variants=variants)
    with pytest.raises(SplashbenchError, match="method grey runs on cpu, not on 'cuda'; leave the device out"):
        plan(balls_directory, "cuda")


def test_long_runs_say_how_far_they_are(
    balls_directory: Path, tmp_path: Path, place: Place, monkeypatch: pytest.MonkeyPatch
) -> None:
    said: list[str] = []
    monkeypatch.setattr(execution, "_SILENT_SECONDS", 0.0)
    monkeypatch.setattr(execution, "_SHOWN_RUNS", 2)
    place.silent = 1
    carry_out_plan(
        plan(balls_directory, "cpu"), tmp_path / "out", ExecutionOptions(on="ray", jobs=None, tell=said.append)
    )
    first = next(line for line in said if "being made" in line)
    assert first.startswith("0 ended; being made: balls__a__seed0__")
    assert "; balls__b__seed0__" in first
    assert first.count(" (Grey: 40% ") == 2
    assert first.endswith(", and 1 more")
    assert "\x1b" not in first


def test_short_ones_do_not(balls_directory: Path, tmp_path: Path, place: Place) -> None:
    said: list[str] = []
    carry_out_plan(
        plan(balls_directory, "cpu"), tmp_path / "out", ExecutionOptions(on="ray", jobs=None, tell=said.append)
    )
    assert not [line for line in said if "being made" in line]
