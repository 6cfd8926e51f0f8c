"""Work on the machines of a Ray cluster (https://docs.ray.io), the extra [cluster].

Ray decides which machine has room, and says when one is gone. Nothing is handed over but names of files: all machines
share a file system.
"""

from __future__ import annotations

import contextlib
import logging
import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from splashbench.cluster import ray_task
from splashbench.cluster.environment import passed_on, thread_limits
from splashbench.cluster.shared_folder import require_answer, shared
from splashbench.cluster.work import Ended, Needs, Work
from splashbench.errors import SplashbenchError

_WAIT_SECONDS = 0.1
#: Between looks at which machines there are.
_LOOK_SECONDS = 2.0
_CHECK_SECONDS, _CONNECT_SECONDS = 120.0, 10.0
#: Until the user is told that no machine has room.
_PATIENCE_SECONDS = 10.0
#: For work that is asked to end, before Ray's processes are ended.
_STOP_SECONDS = 30.0


class RayWorkers:
    """Work on a Ray cluster.

    Args:
        address: HOST:PORT of the cluster's head; None for the cluster that this machine belongs to, or else Ray on
            this machine alone.
        at_once: the most pieces of work; None for as many as there is room for.
        modules: what each worker imports before its first piece of work.
        folder: see `Shared`. inputs: the same.
        needs: of the most demanding work; a cluster without a machine for it is refused.
        tell: is given a line for the user.

    Raises SplashbenchError without Ray, without the cluster, and where a machine does not share the files.
    """

    def __init__(
        self,
        address: str | None,
        at_once: int | None,
        modules: Sequence[str],
        folder: Path,
        inputs: Sequence[Path],
        needs: Needs,
        tell: Callable[[str], None],
    ) -> None:
        self._ray = _import_ray()
        self._address, self._at_once, self._modules = address, at_once, tuple(modules)
        self._folder, self._inputs, self._needs, self._tell = folder, inputs, needs, tell
        self._running: dict[Any, Work] = {}
        self._machines: list[dict[str, Any]] = []
        self._looked = self._had_room = time.monotonic()
        self._exit = contextlib.ExitStack()
        self._folders = [os.path.abspath(folder) for folder in sys.path if folder]  # noqa: PTH100

    def __enter__(self) -> RayWorkers:
        with contextlib.ExitStack() as stack:
            stack.callback(self._ray.shutdown)
            _connect(self._ray, self._address)
            self._asked = stack.enter_context(shared(self._folder, self._inputs))
            # Not as many calls as one likes, which Ray's default would be 1 of for work that has a GPU: it is the
            # worker that uses it, and gives it back.
            remote = self._ray.remote(max_calls=0, max_retries=0)
            self._check, self._carry_out = remote(ray_task.check), remote(ray_task.carry_out)
            self._require_machines()
            self._exit = stack.pop_all()
        return self

    def __exit__(self, *of_error: object) -> None:
        for reference in self._running:
            with contextlib.suppress(Exception):
                self._ray.cancel(reference, force=False)
        if self._running:  # they end what they have started
            with contextlib.suppress(Exception):
                self._ray.wait(list(self._running), num_returns=len(self._running), timeout=_STOP_SECONDS)
        self._running = {}
        self._exit.close()

    def room(self, needs: Needs) -> int:
        if time.monotonic() - self._looked > _LOOK_SECONDS:
            self._look()
        there, without = (self._capacity(each) for each in (needs, replace(needs, gpus=0)))
        # All that runs takes cores; what has no GPU takes none away.
        with_gpus = sum(work.needs.gpus > 0 for work in self._running.values())
        room = min(without, self._at_once or without) - len(self._running)
        if needs.gpus:
            room = min(room, there - with_gpus)
        if there:
            self._had_room = time.monotonic()
        elif not self._running and time.monotonic() - self._had_room > _PATIENCE_SECONDS:
            self._tell(f"waiting for a machine with {_said(needs)}")
            self._had_room = time.monotonic() + 5 * _PATIENCE_SECONDS
        return room

    def _capacity(self, needs: Needs) -> int:
        """How many pieces of work of these needs all machines have room for when nothing runs."""
        return sum(_fits(machine, needs) for machine in self._machines)

    def sharing(self, needs: Needs) -> int:
        # Whoever has no GPU shares the machine, too.
        without = replace(needs, gpus=0)
        shares = (min(_fits(machine, without), self._at_once or sys.maxsize) for machine in self._machines)
        return max(1, max(shares, default=1))

    def start(self, work: Work) -> None:
        needs = work.needs
        options: dict[str, Any] = {"num_cpus": _cores(needs), "num_gpus": needs.gpus}
        if needs.memory_bytes is not None:
            options["memory"] = needs.memory_bytes
        task = self._carry_out.options(**options, scheduling_strategy="SPREAD", name=work.key)
        # Ray's processes hold work to one thread where it does not say how many.
        given = {**passed_on(), **thread_limits(_cores(needs)), **work.environment}
        reference = task.remote(replace(work, environment=given), self._modules, self._folders, self._asked)
        self._running[reference] = work

    def wait(self) -> list[Ended]:
        if not self._running:
            time.sleep(_WAIT_SECONDS)
            return []
        ready, _ = self._ray.wait(list(self._running), num_returns=1, timeout=_WAIT_SECONDS)
        ended = []
        for reference in ready:
            key = self._running.pop(reference).key
            try:
                answer = self._ray.get(reference)
            except self._ray.exceptions.RayTaskError as error:
                raise SplashbenchError(f"a machine of the Ray cluster failed: {_last_line(error)}") from None
            except self._ray.exceptions.RayError as error:
                self._look()
                ended.append(Ended(key, lost=_why(error)))
                continue
            if isinstance(answer, str):
                raise SplashbenchError(answer)
            ended.append(answer)
        return ended

    def _require_machines(self) -> None:
        """Raise SplashbenchError where no machine has room for the work, or one does not share the files."""
        self._look()
        if not any(_fits(machine, self._needs) for machine in self._machines):
            raise SplashbenchError(
                f"no machine of the Ray cluster has {_said(self._needs)}; give smaller --cores, --gpus or --memory, or "
                "start Ray on a larger machine"
            )
        strategy = self._ray.util.scheduling_strategies.NodeAffinitySchedulingStrategy
        answers = {}
        for machine in self._machines:
            if _fits(machine, self._needs):
                pinned = strategy(machine["NodeID"], soft=False)
                task = self._check.options(num_cpus=0, scheduling_strategy=pinned)
                answers[_name(machine)] = task.remote(self._asked, _name(machine))
        for name, reference in answers.items():
            try:
                fault = self._ray.get(reference, timeout=_CHECK_SECONDS)
            except self._ray.exceptions.GetTimeoutError:
                raise SplashbenchError(f"machine {name} of the Ray cluster does not answer; stop Ray there") from None
            except self._ray.exceptions.RayTaskError as error:
                raise SplashbenchError(
                    f"machine {name} of the Ray cluster cannot take part ({_last_line(error)}); install the same "
                    "environment at the same place on every machine"
                ) from None
            except self._ray.exceptions.RayError:
                continue  # it is gone meanwhile
            if fault:
                raise SplashbenchError(fault)
            require_answer(self._asked, name)
        count = len(self._machines)
        at_once = self.room(self._needs)
        self._tell(
            f"Ray: {count} machine{'' if count == 1 else 's'}, {at_once} at once, each with {_said(self._needs)}"
        )

    def _look(self) -> None:
        """See which machines there are."""
        self._looked, self._machines = time.monotonic(), _alive(self._ray)


def cluster_has_gpu(address: str | None) -> bool | None:
    """Whether a machine of the cluster has a GPU; None where there is no cluster, and Ray would be this machine alone.

    address: as of `RayWorkers`. Raises SplashbenchError without Ray, and where no cluster answers at an address.
    """
    ray = _import_ray()
    try:
        if not _connect(ray, address, or_here=False):
            return None
        return any(machine["Resources"].get("GPU", 0) >= 1 for machine in _alive(ray))
    finally:
        ray.shutdown()


def _connect(ray: Any, address: str | None, or_here: bool = True) -> bool:
    """Join the cluster at `address`, or the one of this machine; returns whether there is one.

    or_here: where this machine has none, start Ray on it alone.
    """
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    # It tells that a cluster of this machine alone has a token, which it makes and reads by itself.
    logging.getLogger("ray._private.authentication.authentication_token_setup").setLevel(logging.ERROR)
    quiet = {"log_to_driver": False, "logging_level": logging.ERROR, "include_dashboard": None}
    with _in_own_folder(), _own_signals():
        try:
            if address is not None:
                _require_listener(address)  # Ray would try for minutes
                ray.init(address, **quiet)
                return True
            try:
                ray.init("auto", **quiet)
            except ConnectionError:
                if or_here:
                    ray.init("local", **{**quiet, "include_dashboard": False})
                return False
            return True
        except Exception as error:
            where = address or "this machine"
            raise SplashbenchError(
                f"no Ray cluster answers at {where} ({_last_line(error)}); start one with `ray start --head`, and "
                "give the HOST:PORT that it prints, with the same RAY_AUTH_MODE (docs/study.md, many machines)"
            ) from None


def _alive(ray: Any) -> list[dict[str, Any]]:
    """The cluster's machines."""
    try:
        return [machine for machine in ray.nodes() if machine["Alive"]]
    except Exception as error:
        raise SplashbenchError(
            f"the Ray cluster does not answer any more ({_last_line(error)}); start it, and give the same command "
            "again, which goes on"
        ) from None


def _require_listener(address: str) -> None:
    """Raise OSError where nobody listens at `address`, HOST:PORT."""
    host, _, port = address.rpartition(":")
    socket.create_connection((host.strip("[]"), int(port)), timeout=_CONNECT_SECONDS).close()


def _import_ray() -> Any:
    try:
        import ray
        import ray.exceptions
        import ray.util.scheduling_strategies
    except ImportError:
        raise SplashbenchError(
            "Ray is not installed; in a checkout that all machines see: pip install -c constraints.txt -e '.[cluster]',"
            " or run without --on"
        ) from None
    return ray


@contextmanager
def _in_own_folder() -> Iterator[None]:
    """Stand in this package's folder meanwhile: Ray's processes import from where the driver stands, and a stranger's
    folder may hold a json.py."""
    before = Path.cwd()
    os.chdir(Path(__file__).resolve().parents[2])
    try:
        yield
    finally:
        os.chdir(before)


def _cores(needs: Needs) -> int:
    return 1 if needs.cores is None else needs.cores


@contextmanager
def _own_signals() -> Iterator[None]:
    """Leave what SIGTERM does as it was: Ray would end the process by it without a word."""
    before = signal.getsignal(signal.SIGTERM)
    try:
        yield
    finally:
        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGTERM, before)


def _fits(machine: dict[str, Any], needs: Needs) -> int:
    """How many pieces of work of these needs a machine has room for."""
    has = machine["Resources"]
    counts = [int(has.get("CPU", 0) // _cores(needs))]
    if needs.gpus:
        counts.append(int(has.get("GPU", 0) // needs.gpus))
    if needs.memory_bytes:
        counts.append(int(has.get("memory", 0) // needs.memory_bytes))
    return min(counts)


def _said(needs: Needs) -> str:
    cores = _cores(needs)
    parts = [f"{cores} core{'' if cores == 1 else 's'}"]
    if needs.gpus:
        parts.append(f"{needs.gpus} GPU{'' if needs.gpus == 1 else 's'}")
    if needs.memory_bytes:
        parts.append(f"{needs.memory_bytes / 1e9:g} GB of memory")
    return ", ".join(parts)


def _name(machine: dict[str, Any]) -> str:
    return f"{machine['NodeManagerHostname']} ({machine['NodeID'][:8]})"


def _why(error: Exception) -> str:
    name = type(error).__name__
    if name == "OutOfMemoryError":
        return "its machine ran out of memory, and Ray killed it; give --memory"
    if name in ("NodeDiedError", "OwnerDiedError", "LocalRayletDiedError"):
        return "its machine is gone"
    return "its worker or its machine is gone"


def _last_line(error: BaseException) -> str:
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return lines[-1][:200] if lines else type(error).__name__
