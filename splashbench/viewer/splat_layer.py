"""The liquid's Gaussians: sent once for each timestep and toggled, or one timestep at a time as it is shown.

viser's client merges and sorts all Gaussians it holds, invisible ones too. A graphics card does not notice 600 000 of
them; drawing without one takes a second for 20 000. So timesteps are sent ahead to clients that draw fast, within a
budget, and other clients get the one that is shown. A paused clock shows more of a model that is thinned.
What is small from where clients look is merged first (merging.py), and anew when they come nearer or go farther.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from threading import RLock
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splashbench.scene import Gaussians
from splashbench.viewer.layers import MOST_NODES, Job, Layer, Moment
from splashbench.viewer.merging import Lookout, merged
from splashbench.viewer.splats import PackedGaussians, pack, sound, unit_of

#: Gaussians that are sent ahead, in all timesteps together: 50 timesteps of 12 000.
BUDGET = 600_000
#: Gaussians of a timestep, at the most.
MOST_AT_ONCE = 300_000
# A group that is exchanged keeps its size; where a timestep has more, it gets so much room to spare.
_ROOM = 1.25
# Clients that are so many times nearer or farther get Gaussians made for that.
_STALE = 1.2


class SplatLayer(Layer):
    """The liquid's Gaussians of every timestep.

    Args:
        scene: viser's scene. place: name of the node that the layer's stand under.
        atomic: returns a context whose messages reach clients together.
        frames: the Gaussians of a timestep. n_frames: T.
        lookout: from where they are looked at. middle: [3], of what is looked at.
        budget: Gaussians that are sent ahead, all timesteps together.
    """

    def __init__(
        self,
        scene: Any,
        place: str,
        lock: RLock,  # type: ignore[valid-type]
        atomic: Callable[[], AbstractContextManager[None]],
        frames: Callable[[int], Gaussians | None],
        n_frames: int,
        lookout: Lookout,
        middle: NDArray[np.float64],
        on: bool = True,
        budget: int = BUDGET,
    ) -> None:
        super().__init__("liquid", "liquid", lock, on)
        self._scene, self._place, self._atomic = scene, place, atomic
        self._frames, self._n_frames = frames, n_frames
        self._lookout, self._middle = lookout, middle
        self._each = min(max(1, budget // n_frames), MOST_AT_ONCE)
        self._send_ahead = False
        self._unit: float | None = None
        self._nodes: dict[int, Any] = {}
        # Of each timestep: Gaussians in the model and merged, those left out of its node, from where that was made.
        self._counts: dict[int, tuple[int, int]] = {}
        self._left_out: dict[int, int] = {}
        self._node_lookout: dict[int, Lookout] = {}
        # The group that is exchanged, the timestep it holds, from where that was made, and how many it has room for.
        self._group: Any = None
        self._held: int | None = None
        self._group_lookout = lookout
        self._room = 0
        self._visible: Any = None
        self._t = 0  # the timestep that is shown

    @property
    def send_ahead(self) -> bool:
        """Whether all timesteps are sent, and toggled."""
        return self._send_ahead

    def set_send_ahead(self, ahead: bool, moment: Moment) -> None:
        """Send all timesteps, or one at a time."""
        with self._lock:
            self._send_ahead = ahead = ahead and self._n_frames <= MOST_NODES
            if not ahead:
                for node in self._nodes.values():
                    node.remove()
                self._visible = None if self._visible in self._nodes.values() else self._visible
                self._nodes.clear()
            self.show(moment)

    def look_from(self, lookout: Lookout) -> None:
        """Clients look from `lookout` now."""
        with self._lock:
            self._lookout = lookout

    def _is_stale(self, made: Lookout) -> bool:
        """Whether what was made for `made` is too coarse or too fine by now."""
        now, then = (float(each.pixel(self._middle)) for each in (self._lookout, made))
        return not 1 / _STALE < now / then < _STALE

    def show(self, moment: Moment) -> None:
        """Show the timestep's node, or the group where it holds the whole of what the node holds a part of."""
        self._t = moment.t
        chosen = self._chosen(moment) if self.on else None
        if chosen is self._visible:
            return
        with self._atomic():
            if self._visible is not None:
                self._visible.visible = False
            if chosen is not None:
                chosen.visible = True
        self._visible = chosen

    def _chosen(self, moment: Moment) -> Any:
        if not self._send_ahead:
            return self._group  # of the timestep before for as long as this one takes
        if self._held == moment.t and (self._needs_whole(moment) or moment.t not in self._nodes):
            return self._group
        return self._nodes.get(moment.t)

    def _needs_whole(self, moment: Moment) -> bool:
        return not self._send_ahead or (not moment.playing and self._left_out.get(moment.t, 0) > 0)

    def urgent(self, moment: Moment) -> Job | None:
        """The timestep's node or its exchange."""
        if not self.on:
            return None
        if self._send_ahead and (moment.t not in self._nodes or (not moment.playing and self._is_old(moment.t))):
            return lambda: self._send(moment.t)
        if self._needs_whole(moment) and (self._held != moment.t or self._is_stale(self._group_lookout)):
            return lambda: self._exchange(moment.t)
        return None

    def _is_old(self, t: int) -> bool:
        """Whether the node of timestep `t` is missing, or made for another distance."""
        return t not in self._nodes or self._is_stale(self._node_lookout[t])

    def ahead(self, moment: Moment) -> Job | None:
        """The next node that is missing."""
        if not (self.on and self._send_ahead):
            return None
        later = ((moment.t + k) % self._n_frames for k in range(self._n_frames))
        missing = next((t for t in later if self._is_old(t)), None)
        return None if missing is None else lambda: self._send(missing)

    def _packed(self, t: int, most: int, lookout: Lookout) -> PackedGaussians:
        whole = self._frames(t)
        gaussians = sound(Gaussians.none() if whole is None else whole)
        if self._unit is None and len(gaussians):
            self._unit = unit_of(gaussians)
        fewer = merged(gaussians, lookout)
        packed = pack(fewer, self._unit or 1.0, most)
        with self._lock:
            self._counts[t] = len(gaussians), len(fewer)
        # A group without Gaussians is one that the client cannot draw.
        return packed if len(packed) else packed.padded(1)

    def _send(self, t: int) -> None:
        lookout = self._lookout
        packed = self._packed(t, self._each, lookout)
        with self._lock, self._atomic():
            if not self._send_ahead:  # changed meanwhile
                return
            self._left_out[t], self._node_lookout[t] = packed.left_out, lookout
            node = self._nodes.get(t)
            if node is not None and node.scale == packed.scale:
                node.set_gaussians(**packed.arguments())
                return
            if node is not None:  # made before any Gaussian was seen
                self._visible = None if self._visible is node else self._visible
                node.remove()
            name = f"{self._place}/timestep {t}"
            self._nodes[t] = self._scene.add_gaussian_splats(
                name, scale=packed.scale, visible=False, **packed.arguments()
            )

    def _exchange(self, t: int) -> None:
        lookout = self._lookout
        packed = self._packed(t, MOST_AT_ONCE, lookout)
        with self._lock, self._atomic():
            if len(packed) > self._room:
                self._room = int(len(packed) * _ROOM)
            arguments = packed.padded(self._room).arguments()
            if self._group is not None and self._group.scale != packed.scale:  # made before any Gaussian was seen
                self._group.remove()
                self._visible = None if self._visible is self._group else self._visible
                self._group = None
            if self._group is None:
                name = f"{self._place}/shown"
                self._group = self._scene.add_gaussian_splats(name, scale=packed.scale, visible=False, **arguments)
            else:
                self._group.set_gaussians(**arguments)
            self._held, self._group_lookout = t, lookout

    @property
    def loading(self) -> tuple[int, int] | None:
        """Timesteps that are sent, and T."""
        with self._lock:
            there = len(self._nodes)
            return (there, self._n_frames) if self.on and self._send_ahead and there < self._n_frames else None

    @property
    def remark(self) -> str:
        """Which part of the Gaussians is shown."""
        with self._lock:
            if not self.on or self._t not in self._counts:
                return ""
            whole, fewer = self._counts[self._t]
            most = max(fewer for _, fewer in self._counts.values())
        said = []
        if fewer < whole:
            said.append(
                f"The timestep's {whole} Gaussians are merged to {fewer}, as the browser leaves out what is small from "
                "this far; come nearer and there are more."
            )
        if self._send_ahead and most > self._each:
            paused = "all of them" if most <= MOST_AT_ONCE else f"at most {MOST_AT_ONCE}"
            said.append(f"While it plays, {self._each} of up to {most} are shown; paused, {paused}.")
        elif most > MOST_AT_ONCE:
            said.append(f"{MOST_AT_ONCE} of up to {most} are shown.")
        return " ".join(said)
