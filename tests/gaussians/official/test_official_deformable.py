"""Models of the official Deformable-3DGS: files of the published layout against the published formula."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import official_layouts as layouts
import official_reference as reference
import pytest
import torch
from official_comparison import (
    assert_same_image,
    assert_same_when_loaded,
    boxed,
    expected_deformable,
    named,
    rows_of,
)

from splashbench.errors import SplashbenchError
from splashbench.files import read_json, write_json
from splashbench.gaussians.official.model import OfficialFitted
from splashbench.scene import Scene
from splashbench_methods.deformable_3dgs.official import OfficialDeformable3DGS

POINTS = 20


class TestDeformable:
    NAMES = layouts.DEFORMABLE

    def model(
        self, out: Path, export: Path, scene: Scene, rows: np.ndarray, network: dict, **arguments: object
    ) -> OfficialFitted:
        layouts.write_deformable(out, rows, network, **arguments)
        return OfficialDeformable3DGS().read(out, export, scene.training())

    @pytest.mark.parametrize("synthetic", [False, True], ids=["real", "is_blender"])
    def test_it_is_the_published_formula(self, balls: Scene, nerfies: Path, tmp_path: Path, synthetic: bool) -> None:
        rng = np.random.default_rng(1)
        box = read_json(nerfies / "scene.json")
        rows = boxed(rows_of(self.NAMES, rng), self.NAMES, box)
        assert rows.shape[1] == 62
        network = layouts.deform_network(rng, synthetic)
        fitted = self.model(tmp_path, nerfies, balls, rows, network)
        camera = balls.cameras["6"]
        assert abs(camera.K[:2, 2] - [48, 32]).max() > 1  # which the official code does not see
        for t in (2, 7):
            seconds = float(balls.camera_times["6"][t])
            share = (seconds - balls.times[0]) / (balls.times[-1] - balls.times[0])
            wanted = expected_deformable(rows, network, camera, share, box)
            assert_same_image(fitted.render(camera, seconds).rgb, wanted)

    def test_the_turned_quaternion_is_not_normalised(self, balls: Scene, nerfies: Path, tmp_path: Path) -> None:
        rng = np.random.default_rng(2)
        box = read_json(nerfies / "scene.json")
        rows = boxed(rows_of(self.NAMES, rng, 2), self.NAMES, box)
        network = layouts.deform_network(rng)
        for name, array in network.items():
            if name.startswith("gaussian"):
                array[:] = 0
        network["gaussian_rotation.bias"][:] = [0.3, -0.4, 0.2, 0.5]
        fitted = self.model(tmp_path, nerfies, balls, rows, network)
        with torch.no_grad():
            factors = fitted.model.at(0.3).factors.double().numpy()
        for row, factor in zip(named(self.NAMES, rows), factors):
            wanted = reference.deformable_at(row, network, 0.3, np.zeros(3)).covariance / box["scale"] ** 2
            np.testing.assert_allclose(factor @ factor.T, wanted, rtol=1e-4, atol=1e-9)

    def test_scale_and_center_come_back_to_the_same_pixels(self, balls: Scene, nerfies: Path, tmp_path: Path) -> None:
        # Nothing moves: the octaves of other coordinates would be another network.
        rng = np.random.default_rng(3)
        rows = rows_of(self.NAMES, rng)
        network = layouts.deform_network(rng, scale=0.0)
        images = []
        for i, box in enumerate(({"scale": 1.0, "center": [0.0, 0, 0]}, {"scale": 0.61, "center": [2.0, -1, 4]})):
            export = tmp_path / f"export{i}"
            export.mkdir()
            for name in ("dataset.json", "metadata.json", "splashbench.json"):
                (export / name).write_bytes((nerfies / name).read_bytes())
            write_json(export / "scene.json", box)
            fitted = self.model(tmp_path / f"out{i}", export, balls, boxed(rows, self.NAMES, box), network)
            images.append(fitted.render(balls.cameras["7"], float(balls.times[3])))
        assert_same_image(images[0].rgb, images[1].rgb)
        np.testing.assert_allclose(images[0].alpha, images[1].alpha, atol=1e-3)

    def test_nothing_is_drawn_nearer_than_a_fifth_of_the_codes_units(
        self, balls: Scene, nerfies: Path, tmp_path: Path
    ) -> None:
        rng = np.random.default_rng(4)
        box, camera = read_json(nerfies / "scene.json"), balls.cameras["6"]
        axis = camera.w2c[2, :3]
        depths = np.array([0.19, 0.21]) / box["scale"]
        places = camera.center + depths[:, None] * axis
        rows = rows_of(self.NAMES, rng, 2, x=places[:, 0], y=places[:, 1], z=places[:, 2], opacity=3.0)
        rows = boxed(rows, self.NAMES, box)
        network = layouts.deform_network(rng, scale=0.0)
        for i in range(2):
            fitted = self.model(tmp_path / str(i), nerfies, balls, rows[[i]], network)
            assert (np.ptp(fitted.render(camera, 0.1).rgb) > 0.1) == (i == 1)

    def test_a_white_background_shows_through(self, balls: Scene, nerfies: Path, tmp_path: Path) -> None:
        rng = np.random.default_rng(5)
        box = read_json(nerfies / "scene.json")
        rows = boxed(rows_of(self.NAMES, rng), self.NAMES, box)
        network = layouts.deform_network(rng, scale=0.0)
        fitted = self.model(tmp_path, nerfies, balls, rows, network, white_background=True)
        camera = balls.cameras["6"]
        wanted = expected_deformable(rows, network, camera, 0.0, box, 1.0)
        assert_same_image(fitted.render(camera, float(balls.times[0])).rgb, wanted)

    def test_a_loaded_model_renders_the_same(self, balls: Scene, nerfies: Path, tmp_path: Path) -> None:
        rng = np.random.default_rng(6)
        rows = boxed(rows_of(self.NAMES, rng, 20), self.NAMES, read_json(nerfies / "scene.json"))
        for synthetic in (False, True):
            network = layouts.deform_network(rng, synthetic)
            fitted = self.model(tmp_path / f"out{synthetic}", nerfies, balls, rows, network, white_background=True)
            assert_same_when_loaded(OfficialDeformable3DGS(), fitted, balls, tmp_path / f"model{synthetic}")

    def test_rigid_motions_are_refused_by_name(self, balls: Scene, nerfies: Path, tmp_path: Path) -> None:
        rng = np.random.default_rng(7)
        network = layouts.deform_network(rng)
        for name in ("weight", "bias"):
            network[f"branch_w.{name}"] = network[f"branch_v.{name}"] = network.pop(f"gaussian_warp.{name}")
            network[f"gaussian_warp.{name}"] = network[f"branch_w.{name}"]
            del network[f"gaussian_warp.{name}"]
        with pytest.raises(SplashbenchError, match=r"deform\.pth is of --is_6dof, .*; train without it"):
            self.model(tmp_path, nerfies, balls, rows_of(self.NAMES, rng), network)

    def test_liquid_is_found_through_the_codes_lenses(self, balls: Scene, nerfies: Path, tmp_path: Path) -> None:
        """What the official code sees inside all silhouettes is liquid, though true lenses see it outside."""
        rng = np.random.default_rng(8)
        rows = boxed(rows_of(self.NAMES, rng, 1), self.NAMES, read_json(nerfies / "scene.json"))
        fitted = self.model(tmp_path, nerfies, balls, rows, layouts.deform_network(rng, scale=0.0))
        place = fitted.model.positions.detach().double().numpy()
        training = balls.training()
        inside = {}
        for name, camera in training.cameras.items():
            shifted = camera.project(place)[0][0] - camera.K[:2, 2] + [48, 32]
            inside[name] = shifted
        masks = {name: np.zeros((64, 96), bool) for name in inside}
        for name, (column, row) in inside.items():
            masks[name][int(row), int(column)] = True
        training.mask = lambda name, t: masks[name]  # type: ignore[method-assign]
        assert OfficialFitted(fitted.model, training).liquid(0).tolist() == [True]
