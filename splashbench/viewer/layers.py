"""Layers: what can be shown and hidden, made piece by piece on the worker's thread, and shown by the clock's.

A layer says what it lacks for a moment (`urgent`) and what it could make ahead of time (`ahead`), as jobs. A job that
fails takes its layer out and leaves the others.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from threading import RLock
from typing import Any

#: Scene nodes of a layer that are kept, at the most: of longer recordings those nearest to the shown timestep.
MOST_NODES = 500
#: A piece of work for the worker's thread.
Job = Callable[[], None]


@dataclass(frozen=True)
class Moment:
    """What is shown: timestep `t`, and whether the clock runs."""

    t: int
    playing: bool


class Layer(ABC):
    """Something that can be shown and hidden.

    Args:
        name: one word, as after `--show`. title: for people.
        lock: held while what is shown changes; one for all layers of a scene.
        on: whether it is shown from the start.

    Attributes:
        on: whether it is to be shown. fault: why it cannot be, or "".
    """

    def __init__(self, name: str, title: str, lock: RLock, on: bool = False) -> None:  # type: ignore[valid-type]
        self.name, self.title, self.on, self.fault = name, title, on, ""
        self._lock: Any = lock

    def switch(self, on: bool, moment: Moment) -> None:
        """Show or hide it."""
        with self._lock:
            self.on = on and not self.fault
            self.show(moment)

    def fail(self, fault: str, moment: Moment) -> None:
        """Take it out, because of `fault`."""
        with self._lock:
            self.fault = fault
            self.switch(False, moment)

    @abstractmethod
    def show(self, moment: Moment) -> None:
        """Show what there is of `moment`, hide the rest. Quick: called from the clock's thread."""

    @abstractmethod
    def urgent(self, moment: Moment) -> Job | None:
        """What is missing for `moment`, or None."""

    def ahead(self, moment: Moment) -> Job | None:
        """What may be made for later, or None."""
        return None

    def settings_changed(self) -> None:  # noqa: B027
        """Forget what was made with other settings, such as colours."""

    @property
    def loading(self) -> tuple[int, int] | None:
        """How many pieces are there, and of how many; None where all that is wanted is there."""
        return None

    @property
    def remark(self) -> str:
        """A sentence on what is shown coarser than it is; empty where nothing is."""
        return ""


class FixedLayer(Layer):
    """What does not change over time. make: returns the scene nodes, once."""

    def __init__(
        self,
        name: str,
        title: str,
        lock: RLock,  # type: ignore[valid-type]
        make: Callable[[], Sequence[Any]],
        on: bool = False,
        remark: Callable[[], str] = str,
    ) -> None:
        super().__init__(name, title, lock, on)
        self._make, self._remark = make, remark
        self._nodes: Sequence[Any] | None = None

    def show(self, moment: Moment) -> None:
        """Show or hide the nodes."""
        for node in self._nodes or ():
            node.visible = self.on

    def urgent(self, moment: Moment) -> Job | None:
        """The nodes, once they are wanted."""
        return self._build if self.on and self._nodes is None else None

    def _build(self) -> None:
        nodes = self._make()
        with self._lock:
            self._nodes = nodes
            for node in nodes:
                node.visible = self.on

    @property
    def remark(self) -> str:
        """As given."""
        return self._remark() if self.on else ""


class TimedLayer(Layer):
    """A scene node for each timestep, of which one is visible: they are sent once, and playing sends nothing but that.

    Args:
        make: returns the node of a timestep, invisible, or None where there is nothing then.
        n_frames: T.
        remark: see `Layer.remark`.
    """

    def __init__(
        self,
        name: str,
        title: str,
        lock: RLock,  # type: ignore[valid-type]
        make: Callable[[int], Any],
        n_frames: int,
        on: bool = False,
        remark: Callable[[], str] = str,
    ) -> None:
        super().__init__(name, title, lock, on)
        self._make, self._n_frames, self._remark = make, n_frames, remark
        self._nodes: dict[int, Any] = {}
        self._visible: Any = None
        # Nodes that are under way with earlier settings are thrown away.
        self._version = 0

    def show(self, moment: Moment) -> None:
        """Show the node of `moment`. Where it is not there yet nothing is: another time's would be wrong."""
        node = self._nodes.get(moment.t) if self.on else None
        if node is self._visible:
            return
        if self._visible is not None:
            self._visible.visible = False
        if node is not None:
            node.visible = True
        self._visible = node

    def urgent(self, moment: Moment) -> Job | None:
        """The node of `moment`."""
        return (lambda: self._build(moment.t)) if self.on and moment.t not in self._nodes else None

    def ahead(self, moment: Moment) -> Job | None:
        """The next node after `moment` that is missing."""
        if not self.on or len(self._nodes) >= MOST_NODES:
            return None
        later = ((moment.t + k) % self._n_frames for k in range(self._n_frames))
        missing = next((t for t in later if t not in self._nodes), None)
        return None if missing is None else lambda: self._build(missing)

    def _build(self, t: int) -> None:
        version = self._version
        node = self._make(t)
        with self._lock:
            if version != self._version:
                if node is not None:
                    node.remove()
                return
            self._nodes[t] = node
            if len(self._nodes) > MOST_NODES:
                farthest = max(self._nodes, key=lambda other: abs(other - t))
                gone = self._nodes.pop(farthest)
                self._visible = None if gone is self._visible else self._visible
                if gone is not None:
                    gone.remove()

    def settings_changed(self) -> None:
        """Remove every node."""
        with self._lock:
            self._version += 1
            nodes, self._nodes, self._visible = self._nodes, {}, None
            for node in nodes.values():
                if node is not None:
                    node.remove()

    @property
    def loading(self) -> tuple[int, int] | None:
        """Nodes that are there, and T."""
        wanted = min(self._n_frames, MOST_NODES)
        return (len(self._nodes), wanted) if self.on and len(self._nodes) < wanted else None

    @property
    def remark(self) -> str:
        """As given."""
        return self._remark() if self.on else ""
