"""The rooms of glossy_bowl and clear_liquid: views disagree about a glazed basin; clear liquid tints what is below."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh

pytest.importorskip("embreex")

from splashbench.synth.imaging import shading
from splashbench.synth.imaging.geometry import (
    BASIN,
    BOWL,
    DISH,
    LOOK_AT,
    BowlShape,
    Mesh,
    arc_point,
    bowl_mesh,
    look_at,
    revolve,
)
from splashbench.synth.imaging.lens import LensCamera
from splashbench.synth.imaging.raycast import Tracer
from splashbench.synth.imaging.rendering import RoomView, TracedRoom, depth_above
from splashbench.synth.imaging.room import CaptureRoom, dish_room, glossy_room


@pytest.fixture(scope="module")
def glossy() -> CaptureRoom:
    return glossy_room(0)


@pytest.fixture(scope="module")
def painted_dish() -> CaptureRoom:
    return dish_room(0)


def camera(fraction: float) -> LensCamera:
    K = np.array([[235.0, 0, 80.0], [0, 235.0, 53.0], [0, 0, 1]])
    return LensCamera(160, 107, K, np.zeros(5), look_at(arc_point(fraction), LOOK_AT))


def ball(centre: tuple[float, float, float], radius: float) -> Mesh:
    angle = np.linspace(0, np.pi, 48)
    mesh = revolve(np.stack([radius * np.sin(angle), radius * np.cos(angle)], axis=1), 96)
    return Mesh((mesh.vertices + np.array(centre)).astype(np.float32), mesh.faces, mesh.normals)


def disagreement(room: CaptureRoom) -> float:
    """Median difference of two views' colours over points of the basin's outside that both see, in sRGB units of 1."""
    assert room.bowl is not None
    traced = TracedRoom(room)
    outside = room.bowl.vertices[room.bowl.normals[:, 1] > 0.3]  # normals point into the clay
    points = outside[np.hypot(outside[:, 0], outside[:, 2]) < 0.095]
    colors, seen = [], np.ones(len(points), bool)
    for fraction in (0.1, 0.9):
        lens = camera(fraction)
        to_eye = lens.center - points
        to_eye /= np.linalg.norm(to_eye, axis=1, keepdims=True)
        lifted = (points + 1e-3 * to_eye).astype(np.float32)
        seen &= ~traced.tracer.occluded(lifted, to_eye.astype(np.float32))
        column, row = np.floor(lens.project(points.astype(np.float64))[0]).astype(int).T
        colors.append(RoomView(traced, lens).image[row, column])
    assert seen.sum() > 50
    return float(np.median(np.abs(colors[0] - colors[1])[seen].mean(axis=1)))


@pytest.mark.parametrize("shape", [BOWL, BASIN, DISH])
def test_a_bowl_is_closed_and_its_wall_nowhere_thin(shape: BowlShape) -> None:
    mesh = bowl_mesh(shape, segments=96, rings=48)
    edges = np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]])
    assert {tuple(edge) for edge in edges} == {tuple(edge) for edge in edges[:, ::-1]}
    assert trimesh.Trimesh(mesh.vertices, mesh.outward_faces, process=False).volume > 0
    # A ray that enters the clay square to its surface stays in it for millimetres, and leaves it again.
    into = mesh.normals
    depth = Tracer([(mesh.vertices, mesh.faces)]).nearest(mesh.vertices + 1e-4 * into, into).distance
    away_from_the_table = mesh.vertices[:, 1] > 0.001
    assert depth[away_from_the_table].min() > 0.004
    assert depth[away_from_the_table].max() < 0.1


def test_the_new_bowls_are_of_other_shapes() -> None:
    for shape in (BASIN, DISH):
        assert shape.rim_radius > BOWL.rim_radius
        assert shape.rim_height < BOWL.rim_height
        assert shape.inner_power > 2 * BOWL.inner_power


def test_the_basin_has_one_colour_and_views_disagree_about_it(glossy: CaptureRoom) -> None:
    assert glossy.bowl_albedo is not None
    assert np.ptp(glossy.bowl_albedo, axis=0).max() == 0
    assert disagreement(replace(glossy, glaze=None)) < 0.01
    assert disagreement(glossy) > 0.03


def test_the_glazed_basin_mirrors_the_room_around_it(glossy: CaptureRoom) -> None:
    """Where a mirror ray meets the room, the mirror shows that place's colour."""
    room = TracedRoom(glossy)
    start = np.array([[0.0, 0.3, 0.0]], np.float32)
    seen = room.mirrored(start, np.array([[0.0, 0.0, -1.0]], np.float32))[0]
    painted = TracedRoom(replace(glossy, quads=[replace(q, texture=np.zeros_like(q.texture)) for q in glossy.quads]))
    assert seen.min() > 0.05
    assert np.allclose(painted.mirrored(start, np.array([[0.0, 0.0, -1.0]], np.float32)), 0)
    up = np.array([[0.0, 1.0, 0.0]], np.float32)
    assert np.allclose(room.mirrored(start, up), shading.surroundings(up, glossy.light))


def test_a_glaze_mirrors_little_head_on_and_much_at_a_grazing_angle() -> None:
    normal, view = np.array([[0.0, 1.0, 0.0]], np.float32), np.array([[0.0, -1.0, 0.0]], np.float32)
    straight_up = shading.light_from((0.0, 1.0, 0.0), 0.6, 0.6, (0.0, 1.0, 0.0))
    glaze = shading.Glaze()
    assert glaze.share(normal, view)[0, 0] == pytest.approx(glaze.reflectance)
    assert glaze.glint(normal, view, straight_up)[0, 0] > 1
    assert glaze.glint(normal, view, shading.light_from((1.0, 0.2, 0.0), 0.6, 0.6, (0.0, 1.0, 0.0)))[0, 0] < 1e-6
    grazing = np.array([[0.9998, -0.02, 0.0]], np.float32)
    assert glaze.share(normal, grazing)[0, 0] > 0.85


def test_the_dish_is_painted_all_around_without_a_seam(painted_dish: CaptureRoom) -> None:
    texture = painted_dish.bowl_texture
    assert texture is not None
    assert texture.std(axis=1).max() > 0.1
    inside = np.abs(np.diff(texture, axis=1)).mean()
    assert np.abs(texture[:, 0] - texture[:, -1]).mean() < 2 * inside


def test_depth_of_liquid_towards_the_light_from_inside_and_from_outside() -> None:
    drop = ball((0.0, 0.1, 0.0), 0.03)
    tracer = Tracer([(drop.vertices, drop.faces)])
    points = np.array([[0.001, 0.0, 0.001], [0.001, 0.1, 0.001], [0.001, 0.2, 0.001]], np.float32)
    up = np.broadcast_to(np.array([0, 1, 0], np.float32), points.shape)
    assert depth_above(tracer, points, up) == pytest.approx([0.06, 0.03, 0.0], abs=3e-4)


def test_clear_liquid_tints_its_shadow_and_opaque_liquid_does_not(painted_dish: CaptureRoom) -> None:
    room = painted_dish
    drop = ball((0.0, 0.3, 0.0), 0.03)
    changes = []
    for dye in (room.dye, replace(room.dye, tints_shadow=False)):
        view = RoomView(TracedRoom(replace(room, dye=dye)), camera(0.5))
        frame = view.with_liquid(drop)
        shadow = (np.abs(frame.image - view.image).max(axis=2) > 0) & ~frame.mask
        assert shadow.sum() > 10
        changes.append((view.image - frame.image)[shadow].mean(axis=0))
    tinted, dark = changes
    assert (tinted < dark).all()
    assert tinted[2] > 2 * tinted[0]  # amber: it takes blue light rather than red
    assert not shading.BLUE.tints_shadow


def test_the_new_liquids_are_of_other_colours(glossy: CaptureRoom, painted_dish: CaptureRoom) -> None:
    blue, crimson, amber = shading.BLUE, glossy.dye, painted_dish.dye
    assert {int(np.argmax(dye.albedo)) for dye in (crimson, amber)} == {0}
    assert int(np.argmax(blue.albedo)) == 2
    assert amber.absorption.sum() < blue.absorption.sum()
    assert not glossy.clear_liquid
    assert painted_dish.clear_liquid
