"""A made-up exhibit of which everything is known, and viser's scene as far as layers use it, without a server."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from splashbench.scene import Camera, ContainerMesh, Gaussians, Particles, SignedDistance, VelocityField, look_at
from splashbench.viewer.exhibit import Exhibit

#: Seconds of the timesteps; uneven, as in real recordings.
TIMES = np.array([0.0, 0.1, 0.3, 0.4])
#: Gaussians of a timestep.
NUMBER = 40


def gaussians_of(number: int, deviation: float = 0.02, opacity: float = 0.9, seed: int = 0) -> Gaussians:
    """Round Gaussians of one size and opacity in a ball."""
    rng = np.random.default_rng(seed)
    return Gaussians(
        rng.normal(0, 0.1, (number, 3)),  # type: ignore[arg-type]
        np.tile(np.eye(3) * deviation, (number, 1, 1)),  # type: ignore[arg-type]
        np.full(number, opacity),  # type: ignore[arg-type]
        rng.uniform(0, 1, (number, 3)),  # type: ignore[arg-type]
    )


class MadeUp(Exhibit):
    """Liquid that moves along x by one unit a second, filmed by two cameras; y is up.

    asked: the timesteps whose Gaussians were asked for, in order.
    """

    has_gaussians = has_background = has_particles = has_distance = has_velocity = has_picture = True

    def __init__(self, number: int = NUMBER, times: NDArray[np.float64] = TIMES) -> None:
        self.name, self.place = "made up", Path("made_up")
        self.times, self.real_times = times, True
        self.gravity, self.metres_per_unit = np.array([0.0, -1.0, 0.0]), 0.5
        K = np.array([[300.0, 0, 150], [0, 300, 100], [0, 0, 1]])
        eyes = {"1": (-1.0, 0.5, 2.0), "2": (1.0, 0.5, 2.0)}
        self.cameras = {name: Camera(name, 300, 200, K, look_at(eye)) for name, eye in eyes.items()}
        self.train = ("1",)
        self._number = number
        self.asked: list[int] = []

    def _some_points(self) -> NDArray:
        return gaussians_of(self._number).means

    def gaussians(self, t: int) -> Gaussians:
        self.asked.append(t)
        here = gaussians_of(self._number)
        return Gaussians(here.means + np.array([self.times[t], 0, 0]), here.factors, here.opacities, here.colors)

    def static_gaussians(self) -> Gaussians:
        return gaussians_of(30, deviation=0.1, seed=1)

    def ground(self) -> NDArray[np.uint8]:
        return np.array([200, 150, 100], np.uint8)

    def photograph(self, camera: str, t: int) -> NDArray[np.uint8]:
        return np.full((200, 300, 3), 10 * t + int(camera), np.uint8)

    def container(self) -> ContainerMesh | None:
        return None

    def distance(self, t: int) -> SignedDistance:
        nodes = -0.4 + 0.05 * np.stack(np.meshgrid(*[np.arange(20)] * 3, indexing="ij"), axis=-1)
        phi = np.linalg.norm(nodes - [self.times[t], 0, 0], axis=-1) - 0.2
        return SignedDistance.of(phi[None] / 0.05, np.full(3, -0.4), 0.05)

    def velocity(self, t: int) -> VelocityField:
        values = np.zeros((3, 3, 3, 3), np.float32)
        values[..., 0] = 1.0
        return VelocityField(values, np.full(3, -0.3), np.full(3, 0.3), np.ones((3, 3, 3), bool))

    def _particles(self) -> Particles:
        start = gaussians_of(self._number).means
        return Particles(
            start[None] + np.outer(self.times, [1, 0, 0])[:, None], np.ones((len(self.times), self._number))
        )  # type: ignore[arg-type]

    def picture(self, camera: Camera, t: int) -> NDArray[np.uint8]:
        return np.full((camera.height, camera.width, 3), 20 * t, np.uint8)


class Node:
    """A node of viser's scene. sent: how often its content was."""

    def __init__(self, scene: FakeScene, name: str, kind: str, visible: bool, content: dict[str, Any]) -> None:
        self._scene, self.name, self.kind, self.content = scene, name, kind, content
        self._visible, self.removed, self.sent = visible, False, 1
        self.scale = content.get("scale")
        self.image: Any = content.get("image")
        self.clicked: Any = None

    @property
    def visible(self) -> bool:
        return self._visible

    @visible.setter
    def visible(self, visible: bool) -> None:
        assert not self.removed, f"{self.name} was removed"
        if visible != self._visible:
            self._scene.toggles += 1
        self._visible = visible

    def set_gaussians(self, **content: Any) -> None:
        self.content |= content
        self.sent += 1

    def remove(self) -> None:
        assert not self.removed, f"{self.name} was removed before"
        self.removed = True

    def on_click(self, callback: Any) -> None:
        self.clicked = callback


class FakeScene:
    """Keeps every node that is added. toggles: how often one was shown or hidden."""

    def __init__(self) -> None:
        self.nodes: list[Node] = []
        self.toggles = 0
        self.background: Any = None

    def __getattr__(self, kind: str) -> Any:
        if not kind.startswith("add_"):
            raise AttributeError(kind)

        def add(name: str, *words: Any, visible: bool = True, **content: Any) -> Node:
            for node in self.nodes:  # as in viser, a node takes the place of one with its name
                if node.name == name:
                    node.removed = True
            self.nodes.append(Node(self, name, kind[4:], visible, content | {"words": words}))
            return self.nodes[-1]

        return add

    def set_background_image(self, image: Any, **_: Any) -> None:
        self.background = image

    def set_up_direction(self, up: Any) -> None:
        pass

    def shown(self) -> list[str]:
        """Names of the nodes that are visible."""
        return [node.name for node in self.nodes if node.visible and not node.removed]

    def named(self, name: str) -> Node:
        """The node of that name that is there."""
        (node,) = (node for node in self.nodes if node.name == name and not node.removed)
        return node


class FakeServer:
    """viser's server as far as a stage uses it."""

    def __init__(self) -> None:
        self.scene = FakeScene()
        self.clients: dict[int, Any] = {}

    @contextmanager
    def atomic(self) -> Iterator[None]:
        yield

    def get_clients(self) -> dict[int, Any]:
        return self.clients


@pytest.fixture
def made_up() -> MadeUp:
    return MadeUp()


@pytest.fixture
def server() -> FakeServer:
    return FakeServer()
