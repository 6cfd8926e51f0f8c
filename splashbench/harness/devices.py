"""What a method runs on: the processor, or a device that it and this machine have."""

from __future__ import annotations

from splashbench.errors import SplashbenchError
from splashbench.harness.contract import Method

AUTO = "auto"
CPU = "cpu"
CUDA = "cuda"


def planned_device(method: Method, asked: str, gpu_elsewhere: bool | None) -> str:
    """The device that `asked` means for runs of `method` that are planned.

    gpu_elsewhere: whether one of the other machines that make them has a GPU; None where this one makes them.

    Raises SplashbenchError as `chosen_device`; of other machines it is asked only whether `method` runs on the device.
    """
    if gpu_elsewhere is None:
        return chosen_device(method, asked)
    if asked == AUTO:
        return CUDA if gpu_elsewhere and CUDA in method.devices else method.devices[0]
    _require_runs_on(method, asked)
    return asked


def chosen_device(method: Method, asked: str) -> str:
    """The device that `asked` means for `method`: itself, or for "auto" a GPU where method and machine have one.

    Raises SplashbenchError where the method does not run on it, or this machine has none.
    """
    if asked == AUTO:
        return CUDA if CUDA in method.devices and method.device_fault(CUDA) is None else method.devices[0]
    _require_runs_on(method, asked)
    fault = method.device_fault(asked)
    if fault is not None:
        raise SplashbenchError(f"method {method.id} cannot run on {asked} here: {fault}")
    return asked


def _require_runs_on(method: Method, device: str) -> None:
    if device not in method.devices:
        raise SplashbenchError(
            f"method {method.id} runs on {', '.join(method.devices)}, not on {device!r}; leave the device out"
        )
