"""What the Gaussian methods run on: wherever the shared renderer draws."""

from __future__ import annotations

from typing import ClassVar

from splashbench.harness.contract import Method

CPU = "cpu"


class GaussianMethod(Method):
    """A method whose fit draws by the shared renderer, on the processor or on a CUDA device."""

    devices: ClassVar[tuple[str, ...]] = (CPU, "cuda")

    def device_fault(self, device: str) -> str | None:
        if device == CPU:
            return None
        from splashbench.render import cuda

        return cuda.available()
