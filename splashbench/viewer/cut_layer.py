"""The layer of a cut: one picture at a time, made anew where its timestep or place is another."""

from __future__ import annotations

from collections.abc import Callable
from threading import RLock
from typing import Any

from splashbench.viewer.layers import Job, Layer, Moment


class CutLayer(Layer):
    """A picture of the signed distance, made anew for each timestep and place. make: returns its node, invisible."""

    def __init__(self, name: str, title: str, lock: RLock, make: Callable[[Moment], Any]) -> None:  # type: ignore[valid-type]
        super().__init__(name, title, lock)
        self._make, self._node = make, None
        self._made: int | None = None
        self._version = 0

    def show(self, moment: Moment) -> None:
        """Show the picture where it is of `moment`."""
        if self._node is not None:
            self._node.visible = self.on and self._made == moment.t

    def urgent(self, moment: Moment) -> Job | None:
        """The picture of `moment`."""
        return (lambda: self._build(moment)) if self.on and self._made != moment.t else None

    def _build(self, moment: Moment) -> None:
        version = self._version
        node = self._make(moment)  # takes the place of the one before, whose name it has
        with self._lock:
            self._node, self._made = node, moment.t if version == self._version else None

    def settings_changed(self) -> None:
        """Make it anew."""
        with self._lock:
            self._version += 1
            self._made = None
