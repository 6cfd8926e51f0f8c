"""The control `nothing`: the frozen background alone, as if no liquid had been poured."""

from __future__ import annotations

from typing import ClassVar

from ..scaffold_gs import ScaffoldGS


class Nothing(ScaffoldGS):
    """Renders the static background and a liquid opacity of zero: what scoring gives for doing nothing."""

    id: ClassVar[str] = "nothing"
    title: ClassVar[str] = "control: background only"
    control: ClassVar[bool] = True
    devices: ClassVar[tuple[str, ...]] = ("cpu",)  # what scores are compared with is the same on every machine
