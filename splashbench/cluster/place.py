"""Where work is carried out: here by default, on a Ray cluster where the user names one."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from splashbench.cluster.local import LocalWorkers
from splashbench.cluster.work import Needs, Workers
from splashbench.errors import SplashbenchError

_SCHEME = "ray://"


def workers_at(
    place: str | None,
    at_once: int | None,
    modules: Sequence[str],
    *,
    folder: Path,
    inputs: Sequence[Path],
    needs: Needs,
    tell: Callable[[str], None] = lambda line: None,
) -> Workers:
    """The workers at `place`, see `ray_address`: this machine where it is None.

    Args:
        at_once: the most pieces of work at the same time; None for one here, and for all there is room for on Ray.
        modules: what each worker imports before its first piece of work.
        folder, inputs: what every machine has to see, absolute paths: where results are written, and what is read.
        needs: of the most demanding piece of work.
        tell: is given lines for the user.
    """
    if place is None:
        return LocalWorkers(at_once or 1, modules)
    address = ray_address(place)
    from splashbench.cluster.on_ray import RayWorkers

    return RayWorkers(address, at_once, modules, folder, inputs, needs, tell)


def has_gpu(place: str) -> bool | None:
    """Whether a machine of the cluster at `place` has a GPU; None where no cluster runs, and it is this machine alone.

    Raises SplashbenchError where no cluster answers at the address, and without Ray.
    """
    address = ray_address(place)
    from splashbench.cluster.on_ray import cluster_has_gpu

    return cluster_has_gpu(address)


def ray_address(place: str) -> str | None:
    """HOST:PORT of "ray://HOST:PORT"; None of "ray". Raises SplashbenchError for what is neither."""
    if place == "ray":
        return None
    host, _, port = place.removeprefix(_SCHEME).rpartition(":")
    if not place.startswith(_SCHEME) or not host or not port.isdecimal():
        raise SplashbenchError(
            f"--on {place!r} is no place; give ray, or ray://HOST:PORT as `ray start --head` prints it"
        )
    if port == "10001":
        raise SplashbenchError(
            f"--on {place!r} names the port of Ray Client, which is not used; give that which `ray start --head` "
            "prints, 6379 by default, on a machine of the cluster"
        )
    return f"{host}:{port}"
