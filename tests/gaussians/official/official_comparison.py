"""Official models against the published formulas: rows to test with, lenses of the reference, and comparisons."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import official_layouts as layouts
import official_reference as reference

from splashbench.gaussians.official.model import OfficialFitted
from splashbench.harness.external.importers import Importer
from splashbench.scene import Camera, Scene


def rows_of(names: list[str], rng: np.random.Generator, n: int = 6, **columns: object) -> np.ndarray:
    """Gaussians about the balls' places, of all directions and sizes of some pixels; `columns` override."""
    rows = np.zeros((n, len(names)))
    spread = {"x": 0.25, "y": 0.25, "z": 0.25, "opacity": 1.0, "motion": 0.2, "omega": 0.5, "rot": 1.0}
    spread |= {"f_dc": 1.0, "f_rest": 0.3, "f_t": 1.0, "scale": 0.4, "trbf_scale": 0.3}
    for i, name in enumerate(names):
        rows[:, i] = rng.normal(0, spread.get(name, spread.get(name.rsplit("_", 1)[0], 0.0)), n)
    rows[:, names.index("y")] += 0.5
    for i in range(3):
        rows[:, names.index(f"scale_{i}")] -= 2.6
    for name, value in columns.items():
        rows[:, names.index(name)] = value
    return np.float32(rows).astype(float)


def assert_same_image(got: np.ndarray, wanted: np.ndarray, tolerance: float = 1e-3) -> None:
    """Up to rounding, but where an alpha of 1/255 is drawn in one and left out in the other."""
    difference = np.abs(got - wanted)
    assert np.ptp(wanted) > 0.3
    assert (difference > tolerance).mean() < 1e-3
    assert difference.max() < 2 / 255 + tolerance


def named(names: list[str], rows: np.ndarray) -> list[dict[str, float]]:
    return [dict(zip(names, row)) for row in rows]


def lens_of(camera: Camera, centered: bool = False, scale: float = 1.0, center: object = 0.0) -> object:
    """`camera` for the reference, in units of (x - center) scale."""
    R, t = camera.w2c[:3, :3], camera.w2c[:3, 3]
    cx, cy = (camera.width / 2, camera.height / 2) if centered else camera.K[:2, 2]
    moved = (t + R @ (np.zeros(3) + center)) * scale
    return reference.Lens(camera.width, camera.height, camera.K[0, 0], camera.K[1, 1], cx, cy, R, moved)


def boxed(rows: np.ndarray, names: list[str], box: dict) -> np.ndarray:
    """`rows`, places and sizes in scene units, in the coordinates of a nerfies export."""
    rows, xyz = rows.copy(), slice(0, 3)
    rows[:, xyz] = (rows[:, xyz] - box["center"]) * box["scale"]
    for i in range(3):
        rows[:, names.index(f"scale_{i}")] += np.log(box["scale"])
    return rows


def assert_same_when_loaded(importer: Importer, fitted: OfficialFitted, scene: Scene, directory: Path) -> None:
    directory.mkdir()
    fitted.save(directory)
    loaded = importer.load(directory, scene.training())
    for seconds in scene.times[[0, 4]]:
        a, b = (each.render(scene.cameras["6"], float(seconds)) for each in (fitted, loaded))
        np.testing.assert_array_equal(a.rgb, b.rgb)
        np.testing.assert_array_equal(a.alpha, b.alpha)
    particles = [each.particles() for each in (fitted, loaded)]
    assert particles[0] is not None
    assert particles[1] is not None
    np.testing.assert_array_equal(particles[0].positions, particles[1].positions)


def expected_deformable(
    rows: np.ndarray, network: dict, camera: Camera, t: float, box: dict, background: float = 0.0
) -> np.ndarray:
    lens = lens_of(camera, True, box["scale"], box["center"])
    eye = -lens.R.T @ lens.t
    gaussians = [reference.deformable_at(row, network, t, eye) for row in named(layouts.DEFORMABLE, rows)]
    return np.clip(reference.draw(gaussians, lens, background), 0, 1)


def anchor_rows(rng: np.random.Generator, n: int = 4) -> np.ndarray:
    rows = rows_of(layouts.ANCHORS, rng, n, t=rng.uniform(0, 0.33, n))
    for i, name in enumerate(layouts.ANCHORS):
        if name.startswith(("f_offset", "f_anchor_feat")):
            rows[:, i] = rng.normal(0, 1, n)
    rows[:, layouts.ANCHORS.index("rot_0") :] = [1, 0, 0, 0]
    return np.float32(rows).astype(float)
