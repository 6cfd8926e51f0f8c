"""Where work is carried out: what is refused, in one line with the remedy, before any work starts."""

from __future__ import annotations

import builtins
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from splashbench.cluster.environment import passed_on, thread_limits
from splashbench.cluster.local import LocalWorkers
from splashbench.cluster.place import ray_address, workers_at
from splashbench.cluster.shared_folder import fault_here, require_answer, shared
from splashbench.cluster.work import Needs, Work
from splashbench.errors import SplashbenchError


def test_an_address_is_a_host_and_a_port() -> None:
    assert ray_address("ray") is None
    assert ray_address("ray://head:6379") == "head:6379"


@pytest.mark.parametrize("place", ["slurm", "ray:", "ray://", "ray://head", "ray://head:", "ray://:6379", "head:6379"])
def test_what_is_no_place_is_refused(place: str) -> None:
    with pytest.raises(SplashbenchError, match=r"is no place; give ray, or ray://HOST:PORT"):
        ray_address(place)


def test_the_port_of_ray_client_is_refused() -> None:
    with pytest.raises(SplashbenchError, match="Ray Client, which is not used; give that which `ray start --head`"):
        ray_address("ray://head:10001")


def test_without_a_place_it_is_this_machine(tmp_path: Path) -> None:
    workers = workers_at(None, 3, [], folder=tmp_path, inputs=[], needs=Needs())
    assert isinstance(workers, LocalWorkers)
    assert workers.room(Needs()) == 3


def test_without_ray_one_line_names_the_extra(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    original = builtins.__import__

    def refuse(name: str, *rest: Any) -> Any:
        if name == "ray" or name.startswith("ray."):
            raise ImportError(name)
        return original(name, *rest)

    monkeypatch.setattr(builtins, "__import__", refuse)
    with pytest.raises(
        SplashbenchError, match=r"Ray is not installed; .*pip install -c constraints.txt -e '\.\[cluster\]'"
    ):
        workers_at("ray", None, [], folder=tmp_path, inputs=[], needs=Needs())


def test_a_machine_that_sees_all_has_no_fault(tmp_path: Path) -> None:
    with shared(tmp_path / "out", [tmp_path]) as asked:
        assert fault_here(asked, "second") == ""
        require_answer(asked, "second")
    assert list((tmp_path / "out").iterdir()) == []


def test_a_machine_that_does_not_see_the_folder_is_named_with_the_remedy(tmp_path: Path) -> None:
    with shared(tmp_path / "out", []) as asked:
        (asked.folder / asked.probe).unlink()
        said = fault_here(asked, "second")
    assert said.startswith(
        f"machine second does not see {tmp_path / 'out'}; put it on a file system that every machine"
    )


def test_a_machine_with_another_folder_of_that_name_is_told(tmp_path: Path) -> None:
    with shared(tmp_path / "out", []) as asked:
        (asked.folder / asked.probe).write_text("another word")
        assert "does not see" in fault_here(asked, "second")
    with shared(tmp_path / "out", []) as asked, pytest.raises(SplashbenchError, match="is not seen here"):
        require_answer(asked, "second")


def test_a_machine_that_does_not_see_an_input_is_told(tmp_path: Path) -> None:
    with shared(tmp_path / "out", [tmp_path / "scene"]) as asked:
        assert f"does not see {tmp_path / 'scene'}" in fault_here(asked, "second")


def test_a_machine_with_another_splashbench_is_told(tmp_path: Path) -> None:
    from dataclasses import replace

    with shared(tmp_path / "out", []) as asked:
        assert "install the same one everywhere" in fault_here(replace(asked, version="0.0.1"), "second")
        assert "has no splashbench at" in fault_here(replace(asked, package=tmp_path / "elsewhere"), "second")


def test_threads_are_limited_only_where_cores_are_asked_for() -> None:
    assert thread_limits(None) == {}
    assert thread_limits(2)["OMP_NUM_THREADS"] == "2"


def test_variables_of_this_toolkit_go_along_and_marks_do_not(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SPLASHBENCH_CACHE", "somewhere")
    monkeypatch.setenv("SPLASHBENCH_RUN", "a mark")
    assert passed_on()["SPLASHBENCH_CACHE"] == "somewhere"
    assert "SPLASHBENCH_RUN" not in passed_on()


def machine(cores: int, gpus: int = 0, memory: float = 64e9) -> dict[str, Any]:
    return {"Alive": True, "Resources": {"CPU": float(cores), "GPU": float(gpus), "memory": memory}}


def ray_workers(machines: list[dict[str, Any]], at_once: int | None, tmp_path: Path, running: Sequence[Needs]) -> Any:
    """Workers of a made-up cluster in which work of these needs runs."""
    pytest.importorskip("ray", reason="comes with the extra [cluster]")
    from splashbench.cluster.on_ray import RayWorkers

    workers = RayWorkers(None, at_once, [], tmp_path, [], Needs(), lambda line: None)
    workers._machines = machines
    workers._looked = time.monotonic() + 1000
    work = [Work(str(number), "module:task", tmp_path, tmp_path, needs) for number, needs in enumerate(running)]
    workers._running = {each.key: each for each in work}
    return workers


ONE, GPU = Needs(cores=1), Needs(cores=1, gpus=1)


@pytest.mark.parametrize(
    ("machines", "at_once", "running", "expected"),
    [
        # With and without a GPU: how much more may start.
        ([machine(4, 1)], None, [], (4, 1)),
        ([machine(4, 1)], None, [GPU], (3, 0)),
        ([machine(4, 1)], None, [ONE], (3, 1)),
        ([machine(4, 1)], None, [ONE] * 4, (0, 0)),
        ([machine(4, 1)], 2, [ONE], (1, 1)),
        ([machine(4, 1)], 2, [ONE, GPU], (0, 0)),
        ([machine(64), machine(2, 2)], None, [ONE] * 30, (36, 2)),
        ([machine(64), machine(2, 2)], None, [GPU], (65, 1)),
        ([machine(64)], None, [], (64, 0)),
        ([], None, [], (0, 0)),
    ],
)
def test_room_on_a_cluster(
    machines: list[dict[str, Any]], at_once: int | None, running: list[Needs], expected: tuple[int, int], tmp_path: Path
) -> None:
    workers = ray_workers(machines, at_once, tmp_path, running)
    assert (max(0, workers.room(ONE)), max(0, workers.room(GPU))) == expected


def test_a_gpu_on_a_machine_with_too_few_cores_is_no_room(tmp_path: Path) -> None:
    workers = ray_workers([machine(64), machine(16, 1)], None, tmp_path, [])
    assert workers.room(Needs(cores=32)) == 2
    assert workers.room(Needs(cores=32, gpus=1)) == 0


def test_who_shares_a_machine_with_a_run_on_its_gpu(tmp_path: Path) -> None:
    workers = ray_workers([machine(8, 1)], None, tmp_path, [])
    assert (workers.sharing(ONE), workers.sharing(GPU)) == (8, 8)
    assert ray_workers([machine(8, 1)], 3, tmp_path, []).sharing(GPU) == 3
    assert ray_workers([], None, tmp_path, []).sharing(GPU) == 1
