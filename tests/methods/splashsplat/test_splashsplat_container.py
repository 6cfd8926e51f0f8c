"""What splashsplat knows of the container: the scene's mesh before the masks, and from the masks what they hide."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, cast

import numpy as np
import pytest
import trimesh

from splashbench.background.support import Support
from splashbench.container.footage_vessel import Standing
from splashbench.container.found_vessel import FoundVessel
from splashbench.container.verification import silhouette
from splashbench.container.vessel_body import VesselBody, frame_about, superellipse
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


def found(held: float = 0.97, share: float = 0.8, tilt: float = 0.0) -> Standing:
    """A surface, and the bowl that stands on it, as the footage shows them."""
    up = np.array([tilt, 1.0, 0.0]) / np.hypot(tilt, 1.0)
    heights, radii = np.array([0, 0.02, 0.1]), np.array([0.05, 0.08, 0.1])
    body = VesselBody(np.zeros(3), frame_about(-DOWN), superellipse(0.0, 2.0, 0.0, 48), heights, radii)
    return Standing(Support(up, 0.0, share), FoundVessel(body, (held, held), 2.0, 0.1))


def in_footage(standing: Standing, scene: BallInABowl, masks: bool = True) -> Any:
    """The container where masks are looked at, if so, and then the footage, which shows `standing`."""
    return known_container(cast(TrainingScene, scene), True, masks, lambda: standing)


def test_without_masks_the_footage_tells_gravity_and_what_is_hidden() -> None:
    scene = BallInABowl(masked=False)
    container = in_footage(found(), scene)
    assert container.source == "footage"
    assert container.occlusion.hides
    assert "clean plates" in str(container)
    assert container.gravity == pytest.approx(DOWN)
    assert "surface" in container.gravity_from
    fields = signed_distance_fields(cast(TrainingScene, scene), 64, container=container.occlusion)
    assert fields.sample(0, (MIDDLE - [0, 0.8 * RADIUS, 0])[None])[0] < 0
    assert not in_footage(found(), BallInABowl(masked=False, transparent=True)).occlusion.hides
    # What is stated stays, and masks come first.
    tilted = found(tilt=0.1)
    assert in_footage(tilted, BallInABowl(masked=False, gravity=DOWN)).gravity is DOWN
    assert in_footage(tilted, BallInABowl()).source == "masks"
    assert in_footage(tilted, BallInABowl(), masks=False).source == "footage"


def test_what_is_not_trusted_in_the_footage_tells_gravity_at_most() -> None:
    doubtful = in_footage(found(held=0.5), BallInABowl(masked=False))
    assert (doubtful.source, doubtful.occlusion) == ("none", None)
    assert doubtful.gravity == pytest.approx(DOWN)
    assert "holds 0.50 of what stands" in str(doubtful)
    uneven = in_footage(found(held=0.5, share=0.2), BallInABowl(masked=False))
    assert uneven.gravity is None
    # A vessel says by itself how it stands.
    alone = in_footage(found(share=0.2, tilt=0.3), BallInABowl(masked=False))
    assert alone.gravity == pytest.approx(DOWN)
    # Glass through which no liquid is seen is none, and says no more.
    held = found(share=0.2)
    assert held.vessel is not None
    glass = replace(held, vessel=replace(held.vessel, seen_through=True))
    opaque = in_footage(glass, BallInABowl(masked=False))
    assert (opaque.occlusion, opaque.gravity) == (None, None)
    assert "no liquid shows through walls" in str(opaque)
    clear = in_footage(glass, BallInABowl(masked=False, transparent=True))
    assert (clear.source, clear.occlusion.hides) == ("footage", False)
    refused = replace(held, vessel=replace(held.vessel, refused="the rim is beyond the images"))
    assert "the rim is beyond" in str(in_footage(refused, BallInABowl(masked=False)))
    nothing = in_footage(Standing(None, None), BallInABowl(masked=False))
    assert (nothing.occlusion, nothing.gravity) == (None, None)
    assert "nothing that rises" in str(nothing)


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


def test_masks_that_are_not_looked_at_are_not_read() -> None:
    def unreadable(camera: str) -> np.ndarray | None:
        raise AssertionError(f"read the mask of {camera}")

    scene = BallInABowl()
    scene.container_mask = unreadable  # type: ignore[method-assign]
    assert known(scene, masks=False).source == "none"


@pytest.mark.parametrize(("mesh", "masks"), [(False, False), (True, False)])
def test_either_source_can_be_left_out(mesh: bool, masks: bool) -> None:
    container = known(BallInABowl(gravity=DOWN), mesh, masks)
    assert (container.source, container.occlusion) == ("none", None)
    assert container.gravity is DOWN
    assert str(container) == "not known"


def test_without_masks_nothing_is_known() -> None:
    container = known(BallInABowl(masked=False))
    assert (container.source, container.occlusion, container.gravity) == ("none", None, None)
