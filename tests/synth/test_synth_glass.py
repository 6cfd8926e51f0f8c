"""Clear glass lets through and mirrors what optics says, is seen in the image, and hides nothing from the masks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("embreex")

from splashbench.synth.imaging import shading
from splashbench.synth.imaging.geometry import (
    LOOK_AT,
    TANK_SIZE,
    TANK_WALL,
    Mesh,
    arc_point,
    look_at,
    revolve,
    tank_mesh,
)
from splashbench.synth.imaging.glass import ABSORPTION, Glass
from splashbench.synth.imaging.lens import LensCamera
from splashbench.synth.imaging.raycast import FAR, Tracer
from splashbench.synth.imaging.rendering import RoomView, TracedRoom, thickness
from splashbench.synth.imaging.room import CaptureRoom, tank_room


@pytest.fixture(scope="module")
def room() -> CaptureRoom:
    return tank_room(0)


@pytest.fixture(scope="module")
def camera() -> LensCamera:
    K = np.array([[235.0, 0, 80.0], [0, 235.0, 53.0], [0, 0, 1]])
    return LensCamera(160, 107, K, np.zeros(5), look_at(arc_point(0.8), LOOK_AT))


@pytest.fixture(scope="module")
def through(room: CaptureRoom, camera: LensCamera) -> RoomView:
    return RoomView(TracedRoom(room), camera)


@pytest.fixture(scope="module")
def bare(room: CaptureRoom, camera: LensCamera) -> RoomView:
    return RoomView(TracedRoom(replace(room, glass=None)), camera)


def ball(centre: tuple[float, float, float], radius: float) -> Mesh:
    angle = np.linspace(0, np.pi, 48)
    mesh = revolve(np.stack([radius * np.sin(angle), radius * np.cos(angle)], axis=1), 96)
    return Mesh((mesh.vertices + np.array(centre)).astype(np.float32), mesh.faces, mesh.normals)


def both(*meshes: Mesh) -> Mesh:
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    return Mesh(
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate([mesh.faces + start for mesh, start in zip(meshes, starts)]).astype(np.int32),
        np.concatenate([mesh.normals for mesh in meshes]),
    )


LIQUID = both(ball((0.02, 0.05, 0.02), 0.04), ball((0.0, 0.19, 0.0), 0.015), ball((-0.15, 0.02, 0.09), 0.012))


def ray(*values: float) -> np.ndarray:
    return np.array([values], np.float32)


def test_the_tank_is_closed_and_holds_as_much_glass_as_its_walls() -> None:
    mesh = tank_mesh()
    edges = np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]])
    there, back = ({tuple(edge) for edge in pairs} for pairs in (edges, edges[:, ::-1]))
    assert len(there) == len(edges)
    assert there == back, "every edge has one face on either side, wound alike"
    a, b, c = (mesh.vertices[mesh.faces[:, k]].astype(np.float64) for k in range(3))
    volume = np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6
    inside = TANK_SIZE - TANK_WALL * np.array([2, 1, 2])
    assert volume == pytest.approx(TANK_SIZE.prod() - inside.prod(), rel=1e-5)


def test_a_level_ray_crosses_two_walls_of_five_millimetres() -> None:
    panes = Glass(tank_mesh()).along(np.array([0.01, 0.07, 1.0], np.float32), ray(0, 0, -1))
    assert panes.distance[0] == pytest.approx([0.92, 1.075], abs=1e-5)
    expected = 0.96**2 * np.exp(-0.005 * ABSORPTION)
    assert np.allclose(panes.transmitted[0], expected, atol=1e-4)
    # Head on, each of the two faces mirrors what lies behind the camera.
    seen = shading.surroundings(ray(0, 0, 1))[0]
    assert np.allclose(panes.mirrored[0, 0], 0.04 * seen * (1 + 0.96**2 * np.exp(-0.01 * ABSORPTION)), atol=1e-4)


def test_grazing_rays_see_a_mirror_and_edges_are_pale() -> None:
    glass, eye = Glass(tank_mesh()), np.array([0.5, 0.07, 0.125], np.float32)
    corner = np.array([[0.0, 0.07, 0.08], [0.1095, 0.07, 0.08]], np.float32)  # of the front: its middle, its edge
    directions = corner - eye
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    panes = glass.along(eye, directions)
    head_on = glass.along(np.array([0.01, 0.07, 1.0], np.float32), ray(0, 0, -1))
    assert panes.mirrored[0, 0].mean() > 3 * head_on.mirrored[0, 0].mean()
    assert panes.transmitted[0, 0].mean() < head_on.transmitted[0, 0].mean()
    assert panes.mirrored[1, 0].mean() > panes.mirrored[0, 0].mean() + 0.1


def test_only_walls_within_the_stretch_count() -> None:
    panes = Glass(tank_mesh()).along(np.array([0.01, 0.07, 1.0], np.float32), ray(0, 0, -1))
    light = np.full((1, 3), 0.5, np.float32)
    front = light * panes.transmitted[:, 0] + panes.mirrored[:, 0]
    back = light * panes.transmitted[:, 1] + panes.mirrored[:, 1]
    assert np.allclose(panes.through(light, 0.0, 1.0), front)
    assert np.allclose(panes.through(light, 1.0, FAR), back)
    assert np.allclose(panes.through(light, 0.0, FAR), back * panes.transmitted[:, 0] + panes.mirrored[:, 0])
    assert np.array_equal(panes.through(light, 0.0, 0.9), light)


def test_a_ray_that_misses_the_tank_is_left_alone() -> None:
    panes = Glass(tank_mesh()).along(np.array([0.0, 0.3, 1.0], np.float32), ray(0, 0, -1))
    assert not panes.met.any()
    light = np.full((1, 3), 0.5, np.float32)
    assert np.array_equal(panes.through(light, 0.0, FAR), light)


def test_masks_through_the_glass_are_masks_without_it(through: RoomView, bare: RoomView, room: CaptureRoom) -> None:
    mask = through.with_liquid(LIQUID).mask
    assert mask.sum() > 200
    assert np.array_equal(mask, bare.with_liquid(LIQUID).mask)
    clay = np.full((len(tank_mesh().vertices), 3), 0.5, np.float32)
    opaque = RoomView(TracedRoom(CaptureRoom(room.quads, tank_mesh(), clay)), through.camera).with_liquid(LIQUID)
    assert opaque.mask.sum() < 0.8 * mask.sum()


def test_the_glass_is_seen_before_the_room_and_before_the_liquid(through: RoomView, bare: RoomView) -> None:
    tank = through.container_mask
    difference = np.abs(through.image - bare.image).max(axis=2)
    assert np.median(difference[tank]) > 0.02
    assert np.quantile(difference[tank], 0.95) > 0.1, "edges stand out"
    rim = np.abs(np.roll(tank, 1, 0) * 1 - tank) + np.abs(np.roll(tank, 1, 1) * 1 - tank)
    assert (difference[~tank & (rim == 0)] < 0.02).mean() > 0.99
    seen, plain = through.with_liquid(LIQUID), bare.with_liquid(LIQUID)
    behind = seen.mask & tank
    assert behind.sum() > 100
    assert (np.abs(seen.image - plain.image).max(axis=2)[behind] > 0.004).all()


def test_liquid_before_the_tank_is_not_seen_through_it(through: RoomView, bare: RoomView, camera: LensCamera) -> None:
    near = np.array(LOOK_AT) + 0.5 * (camera.center - LOOK_AT)
    drop = ball((float(near[0]), float(near[1]), float(near[2])), 0.01)
    opaque = [
        RoomView(TracedRoom(replace(v.traced.room, clear_liquid=False)), camera).with_liquid(drop)
        for v in (through, bare)
    ]
    inner = opaque[0].mask & (np.abs(opaque[0].image - through.image).max(axis=2) > 0.05)
    inner &= through.container_mask
    whole = inner & np.roll(inner, 1, 0) & np.roll(inner, -1, 0) & np.roll(inner, 1, 1) & np.roll(inner, -1, 1)
    assert whole.sum() > 20
    assert np.allclose(opaque[0].image[whole], opaque[1].image[whole], atol=1e-6)


def test_the_way_through_a_ball_is_its_diameter_and_through_two_the_sum() -> None:
    one, two = ball((0, 0, 0), 0.02), ball((0, 0, -0.1), 0.01)
    mesh = both(one, two)
    tracer = Tracer([(mesh.vertices, mesh.faces)])
    entered, along = ray(1e-4, 1e-4, 0.02), ray(0, 0, -1)
    assert thickness(tracer, entered, along, np.array([FAR]))[0] == pytest.approx(0.06, abs=3e-4)
    assert thickness(tracer, entered, along, np.array([0.05], np.float32))[0] == pytest.approx(0.04, abs=3e-4)
    assert thickness(tracer, entered, along, np.array([0.02], np.float32))[0] == pytest.approx(0.02, abs=1e-5)


def test_thin_clear_liquid_shows_what_lies_behind_it_and_thick_liquid_its_dye() -> None:
    normal, view = ray(0, 1, 0), ray(0, -1, 0)
    lit, openness = np.array([True]), np.ones(1, np.float32)

    def seen(millimetres: float, light: float) -> np.ndarray:
        behind = shading.Behind(np.full((1, 3), light, np.float32), np.array([millimetres / 1000], np.float32))
        return shading.wet(normal, view, lit, openness, behind)[0]

    contrast = [(seen(mm, 0.8) - seen(mm, 0.2)) / 0.6 for mm in (0.0, 5.0, 50.0)]
    assert np.allclose(contrast[0], 0.98, atol=1e-4)  # all but what the surface mirrors
    assert np.allclose(contrast[1], 0.98 * np.exp(-0.005 * shading.BLUE.absorption), atol=1e-4)
    assert contrast[2][0] < 0.05
    assert np.allclose(seen(1e4, 0.8), shading.wet(normal, view, lit, openness)[0], atol=1e-5)
