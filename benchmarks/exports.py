"""What exports cost and how true they are: bytes and seconds a frame, the files' own rendering, volumes of the meshes.

    python benchmarks/exports.py SUBMISSION... [--scenes SCENE...] [--every N] [--json FILE]

Each submission is exported in every format that it has into a temporary folder, and read back by trimesh and numpy:

bytes, seconds   of a frame: all files of the export, and the wall time of the export, over its frames. Other load on
                 the machine is in the seconds. Loading the submission is not.
PSNR, dB         the .ply of Gaussians drawn by the shared renderer on the background colour that the export names,
                 against the method's own rendering; mean over the test views of every frame, for each degree of the
                 colours. "on black" is without that colour, "with backdrop" on black with the sphere of it.
watertight       how many of the meshes are closed and have one orientation, of how many with liquid.
volume           of a mesh against that of the signed distance below 0, trilinear between its nodes as it is stored:
                 the mean and the largest deviation. Frames of less than 100 voxels of liquid are counted apart.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from splashbench.errors import SplashbenchError
from splashbench.export import Manifest, export_gaussians, export_meshes, export_particles, export_velocity
from splashbench.export.surface import volume_below
from splashbench.files import tree_bytes, write_json
from splashbench.render import rasterize_arrays
from splashbench.replay import Reconstruction, load
from splashbench.scene import Camera, SignedDistance

_FEW_VOXELS = 100
_REFERENCE_LINES = 16


def drawn(path: Path, camera: Camera, background: np.ndarray) -> np.ndarray:
    """The view [H, W, 3] of `camera` of a file of Gaussians, as any reader of such files draws it, on `background`."""
    rows = trimesh.load(path, process=False).metadata["_ply_raw"]["vertex"]["data"]

    def table(*names: str) -> np.ndarray:
        return np.stack([np.asarray(rows[name], dtype=np.float64).ravel() for name in names], axis=1)

    means, scales = table("x", "y", "z"), np.exp(table("scale_0", "scale_1", "scale_2"))
    w, x, y, z = table("rot_0", "rot_1", "rot_2", "rot_3").T
    turns = np.stack(
        [
            np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], axis=1),
            np.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], axis=1),
            np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], axis=1),
        ],
        axis=1,
    )
    opacities = 1 / (1 + np.exp(-table("opacity")[:, 0]))
    directions = means - camera.center
    x, y, z = (directions / np.linalg.norm(directions, axis=1, keepdims=True)).T
    rest = [name for name in rows.dtype.names if name.startswith("f_rest_")]
    degree = {0: 0, 9: 1, 24: 2, 45: 3}[len(rest)]
    # The constants of the published code (Kerbl et al. 2023, utils/sh_utils.py).
    basis = [np.full_like(x, 0.28209479177387814)]
    if degree > 0:
        basis += [-0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x]
    if degree > 1:
        basis += [
            1.0925484305920792 * x * y,
            -1.0925484305920792 * y * z,
            0.31539156525252005 * (2 * z * z - x * x - y * y),
            -1.0925484305920792 * x * z,
            0.5462742152960396 * (x * x - y * y),
        ]
    if degree > 2:
        basis += [
            -0.5900435899266435 * y * (3 * x * x - y * y),
            2.890611442640554 * x * y * z,
            -0.4570457994644658 * y * (4 * z * z - x * x - y * y),
            0.3731763325901154 * z * (2 * z * z - 3 * x * x - 3 * y * y),
            -0.4570457994644658 * x * (4 * z * z - x * x - y * y),
            1.445305721320277 * z * (x * x - y * y),
            -0.5900435899266435 * x * (x * x - 3 * y * y),
        ]
    colors = 0.5 + basis[0][:, None] * table("f_dc_0", "f_dc_1", "f_dc_2")
    for channel in range(3):
        for k, values in enumerate(basis[1:]):
            name = f"f_rest_{channel * len(rest) // 3 + k}"
            colors[:, channel] += values * np.asarray(rows[name], dtype=np.float64).ravel()
    image, _ = rasterize_arrays(
        means.astype(np.float32),
        (turns * scales[:, None]).astype(np.float32),
        opacities.astype(np.float32),
        np.maximum(colors, 0).astype(np.float32),
        camera,
        background=background,
    )
    return np.clip(image, 0, 1)


def psnr(image: np.ndarray, truth: np.ndarray) -> float:
    return float(-10 * np.log10(np.mean((image - truth) ** 2)))


def stored_volume(distance: SignedDistance) -> float:
    """Voxels in which the stored steps are below 0, trilinear between nodes."""
    field = np.pad(distance.phi[0].astype(np.float32), 1, constant_values=127)
    return volume_below(field, _REFERENCE_LINES)


def timed(export: Callable[[Path], Manifest], folder: Path) -> tuple[Manifest, dict[str, float]]:
    start = time.perf_counter()
    manifest = export(folder)
    seconds = time.perf_counter() - start
    frames = len(manifest.times)
    return manifest, {"bytes": tree_bytes(folder) / frames, "seconds": seconds / frames, "frames": frames}


def rendering(
    reconstruction: Reconstruction, manifest: Manifest, folder: Path, background: np.ndarray
) -> dict[str, float]:
    """PSNR of the files in `folder` against the method's own rendering, on the mean and at the least."""
    views = [
        psnr(drawn(folder / name, reconstruction.cameras[camera], background), reconstruction.render(camera, at).rgb)
        for name, at in zip(manifest.files, manifest.times)
        for camera in reconstruction.test
    ]
    return {"psnr": float(np.mean(views)), "least": min(views)}


def gaussians(reconstruction: Reconstruction, times: np.ndarray, folder: Path) -> dict[str, Any]:
    found: dict[str, Any] = {}
    black = np.zeros(3, np.float32)
    for degree in range(4):
        place = folder / f"degree{degree}"
        manifest, figures = timed(lambda out, d=degree: export_gaussians(reconstruction, out, times, degree=d), place)  # type: ignore[misc]
        named = manifest.options.get("background_color") or "#000000"
        color = np.array([int(named[i : i + 2], 16) / 255 for i in (1, 3, 5)], np.float32)
        found[f"ply, degree {degree}"] = {
            **figures,
            **_counts(manifest),
            **rendering(reconstruction, manifest, place, color),
        }
        if degree == 1:
            found["on black"] = rendering(reconstruction, manifest, place, black)
    manifest = export_gaussians(reconstruction, folder / "backdrop", times, backdrop=True)
    found["with backdrop"] = rendering(reconstruction, manifest, folder / "backdrop", black)
    return found


def meshes(reconstruction: Reconstruction, times: np.ndarray, folder: Path) -> dict[str, Any]:
    manifest, figures = timed(lambda out: export_meshes(reconstruction, out, times), folder / "mesh")
    closed, deviations, few = 0, [], []
    for name, at in zip(manifest.files, manifest.times):
        distance = reconstruction.surface(at)
        assert distance is not None
        wanted = stored_volume(distance)
        if wanted == 0:
            continue
        mesh = trimesh.load(folder / "mesh" / name)
        closed += bool(mesh.is_watertight and mesh.is_winding_consistent and mesh.volume > 0)
        (few if wanted < _FEW_VOXELS else deviations).append(mesh.volume / distance.voxel**3 / wanted - 1)
    large = {"mean": float(np.mean(deviations)), "largest": float(np.abs(deviations).max())} if deviations else {}
    small = {"few_voxels": len(few), "largest_few_voxels": float(np.abs(few).max())} if few else {}
    count = {"watertight": closed, "with_liquid": len(deviations) + len(few)}
    return {"mesh": {**figures, **_counts(manifest), **count, **large, **small}}


def particles(reconstruction: Reconstruction, times: np.ndarray, folder: Path) -> dict[str, Any]:
    manifest, figures = timed(lambda out: export_particles(reconstruction, out, times), folder / "particles")
    return {"particles": {**figures, **_counts(manifest)}}


def velocity(reconstruction: Reconstruction, times: np.ndarray, folder: Path) -> dict[str, Any]:
    manifest, figures = timed(lambda out: export_velocity(reconstruction, out, times), folder / "velocity")
    return {"velocity": {**figures, **_counts(manifest)}}


def _counts(manifest: Manifest) -> dict[str, float]:
    """Of a frame, on the mean."""
    return {kind: float(np.mean(values)) for kind, values in manifest.counts.items()}


def measured(reconstruction: Reconstruction, every: int) -> dict[str, Any]:
    """Figures of each format."""
    figures: dict[str, Any] = {}
    times = reconstruction.times[::every]
    for measure in (gaussians, meshes, particles, velocity):
        with tempfile.TemporaryDirectory(prefix="splashbench-") as scratch:
            try:
                figures |= measure(reconstruction, times, Path(scratch))
            except SplashbenchError as error:
                print(f"left out: {error}", file=sys.stderr)
    return figures


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("submissions", nargs="+", type=Path, metavar="SUBMISSION")
    parser.add_argument("--scenes", nargs="+", type=Path, metavar="SCENE", help="of each submission, in their order")
    parser.add_argument("--every", type=int, default=5, metavar="N", help="each N-th timestep (default: 5)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="also write the figures here")
    arguments = parser.parse_args()
    scenes = arguments.scenes or [None] * len(arguments.submissions)
    if len(scenes) != len(arguments.submissions):
        parser.error("give a scene for each submission, or none")
    results: dict[str, Any] = {}
    for submission, scene in zip(arguments.submissions, scenes):
        reconstruction = load(submission, scene=scene)
        print(reconstruction)
        results[submission.name] = measured(reconstruction, arguments.every)
        for name, figures in results[submission.name].items():
            print(f"  {name:14}", ", ".join(f"{key} {value:.5g}" for key, value in figures.items()), flush=True)
    if arguments.json:
        write_json(arguments.json, results)
    return 0


if __name__ == "__main__":
    sys.exit(main())
