"""Scenes of balls over a painted container, for the tests that look for it in the footage."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import trimesh
from scipy.ndimage import map_coordinates

from splashbench.container.verification import silhouette
from splashbench.files import write_png
from splashbench.observe.container import depth_image
from splashbench.scene import Camera
from splashbench.scene.container import ContainerMesh
from splashbench.synth.balls import write_balls_scene


def bowl() -> ContainerMesh:
    """An open bowl 70 cm wide, on the floor."""
    profile = [[0, 0], [0.14, 0], [0.24, 0.07], [0.35, 0.28], [0.32, 0.28], [0.22, 0.10], [0.13, 0.03], [0, 0.03]]
    body = trimesh.creation.revolve(np.array(profile), sections=64)
    return ContainerMesh(body.vertices[:, [0, 2, 1]] * [1, 1, -1], body.faces)


def paint(
    mesh: ContainerMesh, image: np.ndarray, free: np.ndarray, camera: Camera, texture: np.ndarray | None
) -> np.ndarray:
    """`mesh` drawn into `image` where it is `free`: with `texture` [n, n, n, 3] all around it, or in one colour."""
    depth = depth_image(mesh, camera)
    shown = np.isfinite(depth) & free
    v, u = np.nonzero(shown)
    rays = np.stack([u + 0.5, v + 0.5, np.ones(len(u))], axis=1) @ np.linalg.inv(camera.K).T
    world = (rays * depth[shown][:, None] - camera.w2c[:3, 3]) @ camera.w2c[:3, :3]
    painted = image.copy()
    if texture is None:
        painted[shown] = (150, 120, 90)
    else:
        at = ((world + 1) / 2 * (len(texture) - 1)).T
        painted[shown] = np.stack([map_coordinates(texture[..., c], at, order=1) for c in range(3)], axis=1)
    return painted


def write_painted_scene(
    directory: Path, texture: np.ndarray | None, mesh: ContainerMesh | None = None, masked: bool = True
) -> Path:
    """Balls over a bowl, or over another `mesh`, with container masks or without, and nothing else that tells of it."""
    mesh = mesh or bowl()
    scene = write_balls_scene(directory, size=(240, 160), n_frames=3)
    for name, camera in scene.cameras.items():
        if masked:
            mask = silhouette(mesh, np.eye(4), camera)
            write_png(directory / "container_mask" / f"{name}.png", np.where(mask, 255, 0).astype(np.uint8))
        for t in range(scene.n_frames):
            image = paint(mesh, scene.image(name, t), ~scene.mask(name, t), camera, texture)
            write_png(directory / "ims" / name / f"{t:06d}.png", image)
    described = json.loads((directory / "scene.json").read_text())
    (directory / "scene.json").write_text(json.dumps(described | {"gravity": None, "metres_per_unit": None}))
    return directory


def box(size: tuple[float, float, float], height: float = 0.0) -> ContainerMesh:
    """A box [width, height, depth] that stands turned so high above the floor."""
    turned = trimesh.transformations.rotation_matrix(0.4, (0, 1, 0))
    body = trimesh.creation.box(size, turned)
    return ContainerMesh(body.vertices + np.array([0, height + size[1] / 2, 0]), body.faces)


def tank() -> ContainerMesh:
    """What `write_glass_scene` has liquid in."""
    return box((0.6, 0.34, 0.4))


def write_glass_scene(directory: Path, edges: bool = True) -> Path:
    """Balls that fall into a box of glass, in which liquid rests from the third of eight frames on.

    edges: draw those of the glass; else the liquid stands on the floor by itself.
    """
    liquid, glass = box((0.55, 0.12, 0.35), 0.015), tank()
    scene = write_balls_scene(directory, size=(240, 160), n_frames=8)
    for name, camera in scene.cameras.items():
        within = silhouette(glass, np.eye(4), camera)
        rests = silhouette(liquid, np.eye(4), camera)
        corners, _ = camera.project(np.asarray(glass.vertices))
        sides = [(a, b) for a in range(8) for b in range(a) if not _across(glass.vertices[a] - glass.vertices[b])]
        for t in range(scene.n_frames):
            image, mask = scene.image(name, t).copy(), scene.mask(name, t)
            if t > 1:
                image[rests] = (40, 80, 190)
                mask = mask | rests
            if edges:
                image[within] = (0.85 * image[within] + 30).astype(np.uint8)
                for a, b in sides:
                    ends = [tuple(int(at) for at in np.rint(16 * corners[end] - 8)) for end in (a, b)]
                    cv2.line(image, ends[0], ends[1], (200, 225, 220), 1, cv2.LINE_AA, 4)
            write_png(directory / "ims" / name / f"{t:06d}.png", image)
            write_png(directory / "seg" / name / f"{t:06d}.png", np.where(mask, 255, 0).astype(np.uint8))
    described = json.loads((directory / "scene.json").read_text())
    (directory / "scene.json").write_text(json.dumps(described | {"gravity": None, "metres_per_unit": None}))
    return directory


def _across(side: np.ndarray) -> bool:
    """Whether it is a diagonal of the box."""
    turned = trimesh.transformations.rotation_matrix(-0.4, (0, 1, 0))[:3, :3] @ side
    return bool((np.abs(turned) > 1e-6).sum() > 1)
