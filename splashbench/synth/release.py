"""An imitation of the released archive: its exact layout, filled with small synthetic scenes.

The real one has tens of gigabytes. This one takes the same road, from the download to the leaderboard, in minutes. It
holds what the release holds and lacks what the release lacks: no scene.json, hence no times, gravity or scale.

Scans and container masks are those of one bowl that stands on the floor, so where it belongs is known: `bowl_pose`. The
photographs do not show it.
"""

from __future__ import annotations

import tempfile
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from splashbench.files import atomic_path
from splashbench.manifest import load_scenes
from splashbench.scene import Camera, SceneMeta, write_scene
from splashbench.synth.balls import ball_cameras, ball_centers, floor_points, render_balls

_TRAIN, _TEST = ("1", "2", "3", "4", "5"), ("6", "7")
#: Of a zip entry: any fixed instant, so that the same imitation has the same bytes.
_WHEN = (2020, 1, 1, 0, 0, 0)
#: Metres in a unit of the imitation's scenes. A scan is in metres.
METRES_PER_UNIT = 0.25
# The bowl: radius and height along its wall, metres, outside and back inside. The outside is convex.
_BOWL = ((0.0, 0.0), (0.05, 0.0), (0.075, 0.05), (0.07, 0.05), (0.046, 0.005), (0.0, 0.005))
_BOWL_SECTIONS = 24
# Where it stands on the floor, scene units.
_BOWL_PLACE = (0.02, 0.0, 0.05)


@dataclass(frozen=True)
class Imitation:
    """A scene of the imitation. size: (width, height) as recorded, pixels; crops have half of each; frames: timesteps.

    scanned: whether it has a mesh of its container.
    """

    name: str
    size: tuple[int, int] = (192, 128)
    frames: int = 6
    scanned: bool = False


def imitations(
    names: Sequence[str] = (), scanned: Sequence[str] = ("bowl_001", "bowl_002", "bowl_003")
) -> list[Imitation]:
    """The scenes of the release by their names, all 20 for none, small."""
    return [Imitation(name, scanned=name in scanned) for name in load_scenes() if not names or name in names]


def write_release(path: Path, scenes: Sequence[Imitation]) -> None:
    """Write the archive to the file `path`: data/real_scene, data/real_scene_crop, data/meshes."""
    with (
        atomic_path(Path(path)) as temporary,
        zipfile.ZipFile(temporary, "w", zipfile.ZIP_DEFLATED) as archive,
        tempfile.TemporaryDirectory() as scratch,
    ):
        for number, scene in enumerate(scenes):
            for variant in ("real_scene", "real_scene_crop"):
                folder = Path(scratch, variant, scene.name)
                _write_scene(folder, scene, number, cropped=variant == "real_scene_crop")
                for file in sorted(path for path in folder.rglob("*") if path.is_file()):
                    _add(
                        archive, f"data/{variant}/{scene.name}/{file.relative_to(folder).as_posix()}", file.read_bytes()
                    )
                    file.unlink()
            if scene.scanned:
                _add(archive, f"data/meshes/{scene.name}.glb", bytes(_bowl().export(file_type="glb")))


def _add(archive: zipfile.ZipFile, name: str, content: bytes) -> None:
    archive.writestr(zipfile.ZipInfo(name, _WHEN), content, zipfile.ZIP_DEFLATED)


def _write_scene(folder: Path, scene: Imitation, number: int, cropped: bool) -> None:
    cameras: Mapping[str, Camera] = ball_cameras(scene.size)
    left, top = scene.size[0] // 4, scene.size[1] // 4
    shown = {name: _cropped(camera, left, top) if cropped else camera for name, camera in cameras.items()}
    times = np.linspace(0.0, 0.33 + 0.01 * number, scene.frames)
    frames = (
        (name, t, *render_balls(camera, ball_centers(time)))
        for name, camera in shown.items()
        for t, time in enumerate(times)
    )
    write_scene(
        folder,
        cameras=shown,
        train=_TRAIN,
        test=_TEST,
        n_frames=scene.frames,
        frames=frames,
        meta=SceneMeta(name=scene.name),
        initial_points=floor_points(),
        container_masks=None if cropped else {name: _container_mask(camera) for name, camera in shown.items()},
        image_format="jpg",
    )
    (folder / "scene.json").unlink()  # the release has none


def _cropped(camera: Camera, left: int, top: int) -> Camera:
    K = camera.K.copy()
    K[:2, 2] -= (left, top)
    return replace(camera, width=camera.width // 2, height=camera.height // 2, K=K)


def _container_mask(camera: Camera) -> NDArray[np.bool_]:
    """Where `camera` sees the bowl, [H, W]: its outside is convex, so that is the hull of its projected vertices."""
    pose = bowl_pose()
    pixels, _ = camera.project(_bowl().vertices @ pose[:3, :3].T + pose[:3, 3])
    v, u = np.mgrid[: camera.height, : camera.width] + 0.5
    mask = np.ones((camera.height, camera.width), dtype=bool)
    for a, b, c in ConvexHull(pixels).equations:  # a u + b v + c is negative inside
        mask &= a * u + b * v + c <= 0
    return mask


def bowl_pose() -> NDArray[np.float64]:
    """Where the scanned bowl belongs in every scene: [4, 4], metres to scene units."""
    pose = np.eye(4)
    pose[:3, :3] /= METRES_PER_UNIT
    pose[:3, 3] = _BOWL_PLACE
    return pose


def _bowl() -> trimesh.Trimesh:
    """A bowl of 15 centimetres; lengths in metres, y up as in every binary glTF."""
    body = trimesh.creation.revolve(np.array(_BOWL), sections=_BOWL_SECTIONS)
    return trimesh.Trimesh(body.vertices[:, [0, 2, 1]] * (1, 1, -1), body.faces, process=False)
