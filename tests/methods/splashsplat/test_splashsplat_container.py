"""What splashsplat knows of the container: the scene's mesh before the masks, and from the masks what they hide."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, cast

import numpy as np
import pytest
import trimesh

from splashbench.container.verification import silhouette
from splashbench.observe import signed_distance_fields
from splashbench.observe.container import depth_image
from splashbench.scene.camera import Camera, look_at
from splashbench.scene.container import ContainerMesh
from splashbench.scene.scene import TrainingScene
from splashbench_methods.splashsplat.fields.container import known_container

DOWN = np.array([0.0, -1.0, 0.0])
MIDDLE, RADIUS = np.array([0.0, 0.05, 0.0]), 0.03


def bowl() -> ContainerMesh:
    profile = [[0, 0], [0.05, 0], [0.08, 0.02], [0.1, 0.1], [0.096, 0.1], [0.076, 0.024], [0.048, 0.005], [0, 0.005]]
    body = trimesh.creation.revolve(np.array(profile), sections=64)
    return ContainerMesh(body.vertices[:, [0, 2, 1]] * [1, 1, -1], body.faces)


def camera_at(name: str, angle: float, pitch: float) -> Camera:
    angle, pitch = np.deg2rad([angle, pitch])
    eye = 0.9 * np.array([np.cos(pitch) * np.sin(angle), np.sin(pitch), np.cos(pitch) * np.cos(angle)])
    return Camera(name, 240, 200, np.array([[420.0, 0, 120], [0, 420, 100], [0, 0, 1]]), look_at(eye))


@dataclass
class BallInABowl:
    """a ball of 6 cm in a bowl, seen by two cameras from far above and by three whose view the near wall blocks."""

    transparent: bool = False
    mesh: ContainerMesh | None = None
    gravity: np.ndarray | None = None
    container_transparent: bool = False
    masked: bool = True
    name: str = "ball_in_a_bowl"
    n_frames: int = 1
    cameras: dict[str, Camera] = field(default_factory=dict)

    def __post_init__(self) -> None:
        places = [(0, 60), (90, 60), (-30, 20), (200, 20), (120, 20)]
        self.cameras = {str(n): camera_at(str(n), *place) for n, place in enumerate(places)}
        self.train = tuple(self.cameras)

    def container_mesh(self) -> ContainerMesh | None:
        return self.mesh

    def container_mask(self, camera: str) -> np.ndarray | None:
        return silhouette(bowl(), np.eye(4), self.cameras[camera]) if self.masked else None

    def mask(self, camera: str, t: int) -> np.ndarray:
        view = self.cameras[camera]
        ball = trimesh.creation.icosphere(4, RADIUS)
        depth = depth_image(ContainerMesh(ball.vertices + MIDDLE, ball.faces), view)
        shown = np.isfinite(depth)
        return shown if self.transparent else shown & (depth < depth_image(bowl(), view))


def known(scene: BallInABowl, mesh: bool = True, masks: bool = True) -> Any:
    return known_container(cast(TrainingScene, scene), mesh, masks)


def test_the_masks_tell_gravity_and_what_is_hidden() -> None:
    scene = BallInABowl()
    container = known(scene)
    assert container.source == "masks"
    assert container.occlusion.hides
    assert "opaque" in str(container)
    assert np.rad2deg(np.arccos(container.gravity @ DOWN)) < 2
    without = signed_distance_fields(cast(TrainingScene, scene), 64)
    fields = signed_distance_fields(cast(TrainingScene, scene), 64, container=container.occlusion)
    # The views past the near wall carve the ball's lower half away; with the vessel they are silent about it.
    below = (MIDDLE - [0, 0.8 * RADIUS, 0])[None]
    assert without.sample(0, below)[0] > 0
    assert fields.sample(0, below)[0] < 0


def test_liquid_that_is_seen_through_the_walls_makes_the_container_transparent() -> None:
    container = known(BallInABowl(transparent=True))
    assert container.source == "masks"
    assert not container.occlusion.hides
    assert "transparent" in str(container)


def test_what_the_scene_states_comes_first() -> None:
    mesh = bowl()
    container = known(BallInABowl(mesh=mesh))
    assert container.source == "mesh"
    assert container.occlusion.mesh is mesh
    assert container.gravity is None
    stated = known(BallInABowl(gravity=DOWN, container_transparent=True))
    assert stated.source == "masks"
    assert stated.gravity is DOWN
    assert not stated.occlusion.hides


@pytest.mark.parametrize(("mesh", "masks"), [(False, False), (True, False)])
def test_either_source_can_be_left_out(mesh: bool, masks: bool) -> None:
    container = known(BallInABowl(gravity=DOWN), mesh, masks)
    assert (container.source, container.occlusion) == ("none", None)
    assert container.gravity is DOWN
    assert str(container) == "not known"


def test_without_masks_nothing_is_known() -> None:
    container = known(BallInABowl(masked=False))
    assert (container.source, container.occlusion, container.gravity) == ("none", None, None)
