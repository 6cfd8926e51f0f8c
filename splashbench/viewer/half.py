"""A half of the window: a viser server with a stage for each exhibit, of which one is shown, and its clients."""

from __future__ import annotations

import math
import time
from collections import defaultdict, deque
from collections.abc import Callable, Sequence
from threading import RLock
from typing import Any

from splashbench.viewer.exhibit import Exhibit
from splashbench.viewer.geometry import View, client_view, overview, set_client_view
from splashbench.viewer.layers import Moment
from splashbench.viewer.merging import Lookout
from splashbench.viewer.stage import Stage

# Views that were sent to a client and may come back from it, changed by nobody.
_ECHOES = 60
# Pixels of a window's height, before a client says its own.
_USUAL_HEIGHT = 800
# After that long without a move, what is shown is made for the new place.
_SETTLED_SECONDS = 0.4
# A page that opens takes so long at the most to look from where it is let.
_ARRIVAL_SECONDS = 5.0
# Clients that draw slowly draw fewer pixels than their window has, by a part that they do not tell.
_COARSER = 1.25


class Half:
    """Where exhibits are shown.

    Args:
        server: viser's.
        exhibits: that may be shown here. chosen: index of the one that is.
        clicked: called with this half, client and camera name when somebody clicks a camera.
        moved: called with this half, client, view, and whether it was this half that let the client look from there,
            whenever a client's camera moves.
        connected: called with this half and client for each new client.
    """

    def __init__(
        self,
        server: Any,
        exhibits: Sequence[Exhibit],
        chosen: int,
        clicked: Callable[[Half, Any, str], None],
        moved: Callable[[Half, Any, View, bool], None],
        connected: Callable[[Half, Any], None],
    ) -> None:
        self.server, self.chosen = server, chosen
        self._moved, self._connected = moved, connected
        self._sent: defaultdict[int, deque[View]] = defaultdict(lambda: deque(maxlen=_ECHOES))
        self._lock = RLock()
        # From where a client looked last, and when that was.
        self._pending: tuple[Lookout, float] | None = None
        # Clients that do not look from where they were let yet, and until when what they report is viser's first view.
        self._arriving: dict[int, float] = {}
        extent, up = exhibits[0].extent, exhibits[0].up
        self.overview = overview(list(exhibits[0].cameras.values()), extent.middle, extent.size, up)
        self.view = self.overview  # where new clients look from
        self._size = extent.size
        server.scene.set_up_direction(up)
        start = server.initial_camera
        start.position, start.look_at, start.up = self.overview.position, self.overview.look_at, self.overview.up
        start.fov, start.near, start.far = self.overview.fov, 2e-3 * extent.size, 2e3 * extent.size
        self.stages = [
            Stage(
                server,
                exhibit,
                f"/exhibit {number}",
                lambda client, name: clicked(self, client, name),
                lookout_of(self.overview, _USUAL_HEIGHT),
                extent,
            )
            for number, exhibit in enumerate(exhibits)
        ]
        for number, stage in enumerate(self.stages):
            stage.set_visible(number == chosen)
        server.on_client_connect(self._welcome)
        server.on_client_disconnect(self._forget)

    @property
    def stage(self) -> Stage:
        """The stage that is shown."""
        return self.stages[self.chosen]

    def choose(self, number: int, moment: Moment) -> None:
        """Show exhibit `number` at its `moment`."""
        for index, stage in enumerate(self.stages):
            if index != number:  # first, as what is behind the scene is one for all stages
                stage.set_visible(False)
        self.chosen = number
        self.stage.show(moment)
        self.stage.set_visible(True)

    def clients(self) -> list[Any]:
        """Those that look."""
        return list(self.server.get_clients().values())

    def set_view(self, client: Any, view: View) -> None:
        """Let `client` look from there; what it reports of that is no move."""
        with self._lock:
            self._sent[client.client_id].append(view)
        set_client_view(client, view)

    def settle(self, at_once: bool = False) -> bool:
        """Make what is shown for where its clients look from, once that has not changed for a moment; whether so."""
        with self._lock:
            if self._pending is None:
                return False
            if not at_once and time.monotonic() - self._pending[1] < _SETTLED_SECONDS:
                return False
            lookout, self._pending = self._pending[0], None
        for stage in self.stages:
            stage.look_from(lookout)
        return True

    def _welcome(self, client: Any) -> None:
        client.camera.min_orbit_distance = 1e-2 * self._size
        if not client_view(client).near(self.view):
            self._arriving[client.client_id] = time.monotonic() + _ARRIVAL_SECONDS
            self.set_view(client, self.view)
        client.camera.on_update(lambda _: self._report(client))
        with self._lock:
            self._pending = lookout_of(self.view, int(client.camera.image_height)), time.monotonic()
        self._connected(self, client)

    def _forget(self, client: Any) -> None:
        self._sent.pop(client.client_id, None)
        self._arriving.pop(client.client_id, None)

    def _report(self, client: Any) -> None:
        view = client_view(client)
        with self._lock:
            echo = view.near(self.view) or any(view.near(sent) for sent in self._sent[client.client_id])
            if echo:
                self._arriving.pop(client.client_id, None)
            elif time.monotonic() < self._arriving.get(client.client_id, 0.0):
                return
            self._pending = lookout_of(view, int(client.camera.image_height)), time.monotonic()
        self._moved(self, client, view, echo)


def lookout_of(view: View, height: int) -> Lookout:
    """From where somebody looks who sees `view` in a window `height` pixels high; with a little to spare."""
    return Lookout(view.position, _COARSER * 2 * math.tan(view.fov / 2) / max(height, 1))
