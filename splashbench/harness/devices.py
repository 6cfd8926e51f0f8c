"""What a method runs on: the processor, or a device that it and this machine have."""

from __future__ import annotations

from splashbench.errors import SplashbenchError
from splashbench.harness.contract import Method

AUTO = "auto"
CUDA = "cuda"


def chosen_device(method: Method, asked: str) -> str:
    """The device that `asked` means for `method`: itself, or for "auto" a GPU where method and machine have one.

    Raises SplashbenchError where the method does not run on it, or this machine has none.
    """
    if asked == AUTO:
        return CUDA if CUDA in method.devices and method.device_fault(CUDA) is None else method.devices[0]
    if asked not in method.devices:
        raise SplashbenchError(
            f"method {method.id} runs on {', '.join(method.devices)}, not on {asked!r}; leave the device out"
        )
    fault = method.device_fault(asked)
    if fault is not None:
        raise SplashbenchError(f"method {method.id} cannot run on {asked} here: {fault}")
    return asked
