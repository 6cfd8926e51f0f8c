"""Whether the Gaussian methods can fit on a device of this machine."""

from __future__ import annotations


def device_fault(device: str) -> str | None:
    """Why nothing can be rendered on `device` here, with the remedy; None where it can."""
    if device == "cpu":
        return None
    from splashbench.render import cuda

    return cuda.available()
