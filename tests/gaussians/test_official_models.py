"""Models of the official codes: files of the published layouts against the published formulas, and hostile files."""

from __future__ import annotations

import importlib.util
import json
import os
import pickle
import re
import shlex
import sys
import warnings
import zipfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch

from splashbench.cli.main import main
from splashbench.errors import SplashbenchError
from splashbench.files import read_image, read_json, write_json
from splashbench.gaussians.official.checkpoint import read_weights
from splashbench.gaussians.official.model import OfficialFitted
from splashbench.gaussians.official.output_folder import TrainingArguments
from splashbench.gaussians.official.point_cloud import read_point_cloud
from splashbench.gaussians.torch_threads import one_torch_thread
from splashbench.harness.external.importers import Importer, load_importer, registered_importers
from splashbench.observe import initial_points
from splashbench.scene import Camera, Scene
from splashbench.scene.export import export_scene
from splashbench.submission import Submission
from splashbench.synth.balls import write_balls_scene
from splashbench_methods.deformable_3dgs.official import OfficialDeformable3DGS
from splashbench_methods.scaffold_4d.official import OfficialScaffold4D, in_the_image
from splashbench_methods.spacetime_gaussians.official import OfficialSpacetimeGaussians


def _module(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, Path(__file__).with_name(f"{name}.py"))
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # where its NamedTuples look for their annotations
    spec.loader.exec_module(module)
    return module


POINTS = 20
layouts, reference = _module("official_layouts"), _module("official_reference")


@pytest.fixture(autouse=True)
def _one_thread() -> Iterator[None]:
    with one_torch_thread(), torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        yield


@pytest.fixture(scope="module")
def nerfies(balls: Scene, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("nerfies") / "NeRF" / "balls"
    export_scene(balls, out, "nerfies", initial_points(balls, POINTS))
    return out


@pytest.fixture(scope="module")
def late(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    """A scene whose cameras each have a clock of their own."""
    return write_balls_scene(tmp_path_factory.mktemp("scenes") / "balls", delays={"2": 0.011, "6": 0.017, "7": -0.006})


@pytest.fixture(scope="module")
def blender(late: Scene, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("blender") / "balls"
    export_scene(late, out, "blender", initial_points(late, POINTS), test_images="blank")
    return out


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


class TestDeformable:
    NAMES = layouts.DEFORMABLE

    def expected(
        self, rows: np.ndarray, network: dict, camera: Camera, t: float, box: dict, background: float = 0.0
    ) -> np.ndarray:
        lens = lens_of(camera, True, box["scale"], box["center"])
        eye = -lens.R.T @ lens.t
        gaussians = [reference.deformable_at(row, network, t, eye) for row in named(self.NAMES, rows)]
        return np.clip(reference.draw(gaussians, lens, background), 0, 1)

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
            wanted = self.expected(rows, network, camera, share, box)
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
        wanted = self.expected(rows, network, camera, 0.0, box, 1.0)
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


class TestSpacetime:
    def decoder(self, rng: np.random.Generator) -> dict[str, np.ndarray]:
        return {"mlp1.weight": rng.normal(0, 0.5, (6, 12, 1, 1)), "mlp2.weight": rng.normal(0, 0.5, (3, 6, 1, 1))}

    def model(
        self, out: Path, scene: Scene, rows: np.ndarray, decoder: dict | None = None, **arguments: object
    ) -> OfficialFitted:
        layouts.write_spacetime(out, rows, decoder, **arguments)
        return OfficialSpacetimeGaussians().read(out, out, scene.training())

    @pytest.mark.parametrize("ending", ["sandwich", "sandwichnoact"])
    def test_the_full_model_is_the_published_formula(self, late: Scene, tmp_path: Path, ending: str) -> None:
        rng = np.random.default_rng(1)
        rows = rows_of(layouts.FULL, rng, trbf_center=rng.uniform(0, 1, 6))
        assert rows.shape[1] == 38
        decoder = self.decoder(rng)
        fitted = self.model(tmp_path, late, rows, decoder, rgbfunction=ending)
        camera, lens = late.cameras["6"], lens_of(late.cameras["6"])
        for t in (0, 5):
            gaussians = [reference.spacetime_at(row, t / 8) for row in named(layouts.FULL, rows)]
            wanted = reference.sandwich(reference.draw(gaussians, lens), lens, decoder, ending == "sandwich")
            got = fitted.render(camera, float(late.camera_times["6"][t])).rgb
            assert_same_image(got, wanted)

    def test_the_lite_model_is_the_published_formula(self, late: Scene, tmp_path: Path) -> None:
        rng = np.random.default_rng(2)
        rows = rows_of(layouts.LITE, rng, trbf_center=rng.uniform(0, 1, 6))
        assert rows.shape[1] == 32
        arguments = {"rgbfunction": "None", "loader": "colmap", "source_path": "/data/colmap_2", "duration": 5}
        fitted = self.model(tmp_path, late, rows, **arguments)
        camera = late.cameras["7"]
        for t in (2, 6):
            gaussians = [reference.spacetime_at(row, (t - 2) / 5) for row in named(layouts.LITE, rows)]
            wanted = np.clip(reference.draw(gaussians, lens_of(camera, centered=True)), 0, 1)
            got = fitted.render(camera, float(late.camera_times["7"][t])).rgb
            assert_same_image(got, wanted)

    def test_behind_a_lite_model_there_may_be_white(self, balls: Scene, tmp_path: Path) -> None:
        rng = np.random.default_rng(2)
        rows = rows_of(layouts.LITE, rng, trbf_center=rng.uniform(0, 1, 6))
        fitted = self.model(tmp_path / "trained", balls, rows, white_background=True)
        camera = balls.cameras["7"]
        gaussians = [reference.spacetime_at(row, 2 / 8) for row in named(layouts.LITE, rows)]
        wanted = np.clip(reference.draw(gaussians, lens_of(camera), background=1.0), 0, 1)
        assert_same_image(fitted.render(camera, float(balls.camera_times["7"][2])).rgb, wanted)
        assert_same_when_loaded(OfficialSpacetimeGaussians(), fitted, balls, tmp_path / "kept")

    def test_white_behind_a_full_model_is_refused(self, balls: Scene, tmp_path: Path) -> None:
        rng = np.random.default_rng(6)
        with pytest.raises(SplashbenchError, match=r"cfg_args: white_background, .*; train without it"):
            self.model(tmp_path, balls, rows_of(layouts.FULL, rng), self.decoder(rng), white_background=True)

    def test_a_middle_cy_takes_cx_with_it(self, balls: Scene, tmp_path: Path) -> None:
        fitted = self.model(tmp_path, balls, rows_of(layouts.LITE, np.random.default_rng(3)))
        camera = balls.cameras["6"]
        K = camera.K.copy()
        K[1, 2] = camera.height / 2
        assert fitted.lens(replace(camera, K=K)).K[:2, 2].tolist() == [48, 32]
        assert fitted.lens(camera) == camera

    def test_between_timesteps_time_runs_evenly(self, balls: Scene, tmp_path: Path) -> None:
        fitted = self.model(tmp_path, balls, rows_of(layouts.LITE, np.random.default_rng(4)))
        middle = float(balls.times[2] + balls.times[3]) / 2
        assert fitted.model_time(middle) == pytest.approx(2.5 / 8)
        assert fitted.model_time(float(balls.times[-1])) == pytest.approx(7 / 8)
        step = float(balls.times[-1] - balls.times[-2])
        assert fitted.model_time(float(balls.times[-1]) + step) == pytest.approx(1.0)

    def test_a_loaded_model_renders_the_same(self, balls: Scene, tmp_path: Path) -> None:
        rng = np.random.default_rng(5)
        full = self.model(
            tmp_path / "a", balls, rows_of(layouts.FULL, rng, 20), self.decoder(rng), rgbfunction="sandwichnoact"
        )
        lite = self.model(tmp_path / "b", balls, rows_of(layouts.LITE, rng, 20), loader="colmap")
        for name, fitted in (("full", full), ("lite", lite)):
            assert_same_when_loaded(OfficialSpacetimeGaussians(), fitted, balls, tmp_path / name)

    @pytest.mark.parametrize(
        ("arguments", "message"),
        [
            ({"rgbfunction": "rgbv1"}, "cfg_args: rgbfunction is 'rgbv1'; train with sandwich or sandwichnoact"),
            ({"duration": 0}, "cfg_args: duration is 0, no number of timesteps"),
            ({"duration": "x"}, "cfg_args: duration is 'x', not a number"),
        ],
    )
    def test_arguments_that_say_nothing_are_named(
        self, balls: Scene, tmp_path: Path, arguments: dict, message: str
    ) -> None:
        rng = np.random.default_rng(6)
        with pytest.raises(SplashbenchError, match=message):
            self.model(tmp_path, balls, rows_of(layouts.FULL, rng), self.decoder(rng), **arguments)

    def test_missing_arguments_are_asked_for(self, balls: Scene, tmp_path: Path) -> None:
        layouts.write_spacetime(tmp_path, rows_of(layouts.LITE, np.random.default_rng(7)), None)
        (tmp_path / "cfg_args").unlink()
        with pytest.raises(SplashbenchError, match="cfg_args is missing; keep it beside point_cloud"):
            OfficialSpacetimeGaussians().read(tmp_path, tmp_path, balls.training())


class TestScaffold:
    def rows(self, rng: np.random.Generator, n: int = 4) -> np.ndarray:
        rows = rows_of(layouts.ANCHORS, rng, n, t=rng.uniform(0, 0.33, n))
        for i, name in enumerate(layouts.ANCHORS):
            if name.startswith(("f_offset", "f_anchor_feat")):
                rows[:, i] = rng.normal(0, 1, n)
        rows[:, layouts.ANCHORS.index("rot_0") :] = [1, 0, 0, 0]
        return np.float32(rows).astype(float)

    def expected(self, rows: np.ndarray, heads: dict, camera: Camera, t: float, **variant: object) -> np.ndarray:
        lens = lens_of(camera)._replace(slopes=(np.tan(-0.5), np.tan(-0.5)))
        eye = -lens.R.T @ lens.t
        shown = [row for row in named(layouts.ANCHORS, rows) if reference.anchor_shows(row, lens)]
        gaussians = [g for row in shown for g in reference.anchor_at(row, heads, t, eye, **variant)]
        return np.clip(reference.draw(gaussians, lens), 0, 1)

    def model(
        self, out: Path, export: Path, scene: Scene, rows: np.ndarray, heads: dict, traced: bool = True, **words: object
    ) -> OfficialFitted:
        layouts.write_scaffold(out, rows, heads, traced, **words)
        return OfficialScaffold4D().read(out, export, scene.training())

    @pytest.mark.parametrize(
        ("words", "variant"),
        [
            ({}, {}),
            ({"temporal_opacity": "4dgs", "use_flow": False}, {"ours": False, "flows": False}),
            ({"hparam_beta": 2.0, "frame_ratio": 1.0}, {"beta": 2.0}),
        ],
    )
    def test_it_is_the_published_formula(
        self, late: Scene, blender: Path, tmp_path: Path, words: dict, variant: dict
    ) -> None:
        rng = np.random.default_rng(1)
        rows, heads = self.rows(rng), layouts.scaffold_heads(rng)
        assert rows.shape[1] == 89
        fitted = self.model(tmp_path, blender, late, rows, heads, traced=not words, **words)
        camera, facts = late.cameras["7"], read_json(blender / "splashbench.json")
        seconds = float(late.camera_times["7"][4])
        t = (seconds - facts["time_origin_seconds"]) / facts["time_span_seconds"] * words.get("frame_ratio", 0.33)
        wanted = self.expected(rows, heads, camera, t, **variant)
        assert_same_image(fitted.render(camera, seconds).rgb, wanted)

    def test_anchors_that_do_not_show_give_nothing(self, late: Scene, blender: Path, tmp_path: Path) -> None:
        rng = np.random.default_rng(2)
        rows, heads = self.rows(rng, 24), layouts.scaffold_heads(rng)
        camera = late.cameras["6"]
        # All about the frame, a good deal of them just outside.
        pixels = rng.uniform([-30, -30], [126, 94], (24, 2))
        rays = np.concatenate([(pixels - camera.K[:2, 2]) / camera.K[[0, 1], [0, 1]], np.ones((24, 1))], axis=1)
        rows[:, :3] = np.float32(camera.center + 1.5 * rays @ camera.w2c[:3, :3])
        for i in range(3):
            rows[:, layouts.ANCHORS.index(f"scale_{i}")] = np.float32(-4.0)
        lens = lens_of(camera)._replace(slopes=(np.tan(-0.5), np.tan(-0.5)))
        shown = [reference.anchor_shows(row, lens) for row in named(layouts.ANCHORS, rows)]
        assert 5 < sum(shown) < 20
        fitted = self.model(tmp_path, blender, late, rows, heads, traced=False)
        found = in_the_image(
            fitted.model.positions[:, :3], fitted.model.log_scales.detach()[:, :3], camera, fitted.model.near
        )
        assert found.tolist() == shown
        seconds = float(late.camera_times["6"][3])
        t = fitted.model_time(seconds)
        assert_same_image(fitted.render(camera, seconds).rgb, self.expected(rows, heads, camera, t))

    def test_a_loaded_model_renders_the_same(self, late: Scene, blender: Path, tmp_path: Path) -> None:
        rng = np.random.default_rng(3)
        words = {"temporal_opacity": "4dgs", "white_background": True}
        fitted = self.model(
            tmp_path / "out", blender, late, self.rows(rng, 12), layouts.scaffold_heads(rng), False, **words
        )
        assert_same_when_loaded(OfficialScaffold4D(), fitted, late, tmp_path / "model")

    @pytest.mark.parametrize(
        ("words", "message"),
        [
            ({"appearance_dim": 32}, "cfg_args: colours depend on .*; train with --appearance_dim 0"),
            ({"use_feat_bank": True}, "cfg_args: models with --use_feat_bank are not read; train without it"),
        ],
    )
    def test_other_models_are_refused_by_name(
        self, late: Scene, blender: Path, tmp_path: Path, words: dict, message: str
    ) -> None:
        rng = np.random.default_rng(4)
        with pytest.raises(SplashbenchError, match=message):
            self.model(tmp_path, blender, late, self.rows(rng), layouts.scaffold_heads(rng), False, **words)

    def test_other_sizes_are_named(self, late: Scene, blender: Path, tmp_path: Path) -> None:
        rng = np.random.default_rng(5)
        with pytest.raises(SplashbenchError, match=r"cov_mlp\.pt: 2\.weight is float32 \[40, 32\], not .* \[80, 32\]"):
            self.model(tmp_path, blender, late, self.rows(rng), layouts.scaffold_heads(rng, 5) | {
                "opacity_mlp": layouts.scaffold_heads(rng)["opacity_mlp"]
            })  # fmt: skip


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


def _leaves(trained: Path) -> str:
    """A command that stands in for a training: it leaves what is in `trained`."""
    return shlex.join([sys.executable, layouts.__file__, "{scene}", "{out}", str(trained)])


def _checked_and_scored(
    scene: Scene, folder: Path, capsys: pytest.CaptureFixture[str], *options: str
) -> tuple[Path, dict[str, float]]:
    """A code that leaves `folder`/trained, through run, check and score: the submission, and its figures."""
    out = folder / "submission"
    arguments = ["run-external", str(scene.directory), str(out), "--name", "theirs", *options]
    arguments += ["--command", _leaves(folder / "trained"), "--points", str(POINTS), "--timing-frames", "1", "--json"]
    assert main(arguments) == 0
    assert json.loads(capsys.readouterr().out)["status"] == "ok"
    assert main(["check", str(out), "--scene", str(scene.directory)]) == 0
    capsys.readouterr()
    assert main(["score", str(out), "--scene", str(scene.directory), "--out", str(folder / "r"), "--json"]) == 0
    (result,) = json.loads(capsys.readouterr().out)["results"]
    assert Submission.open(out).identity.mixed  # the importer says so
    return out, result["metrics"]


def test_the_command_trains_imports_checks_and_scores(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "deformable_3dgs" in registered_importers()
    balls, nerfies = write_balls_scene(tmp_path / "balls", n_frames=3), tmp_path / "NeRF" / "balls"
    export_scene(balls, nerfies, "nerfies", initial_points(balls, POINTS))
    rng = np.random.default_rng(0)
    rows, network = layouts.points_of(nerfies, rng), layouts.deform_network(rng, scale=0.01)
    layouts.write_deformable(tmp_path / "trained", rows, network)
    out, metrics = _checked_and_scored(balls, tmp_path, capsys, "--format", "nerfies", "--import", "deformable_3dgs")
    assert metrics["psnr"] > 5
    assert metrics["primitives_per_frame"] == 40
    # The picture that was scored is the one of the published formulas.
    share = (balls.times[1] - balls.times[0]) / (balls.times[-1] - balls.times[0])
    box = read_json(nerfies / "scene.json")
    wanted = TestDeformable().expected(np.float32(rows), network, balls.cameras["7"], float(share), box)
    got = read_image(out / "renders" / "7" / "000001.png") / 255
    assert_same_image(got, np.round(wanted * 255) / 255, 1.01 / 255)


@pytest.mark.parametrize(("importer", "layout"), [("spacetime_gaussians", "colmap"), ("scaffold_4d", "blender")])
def test_the_other_codes_take_the_same_road(
    importer: str, layout: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    balls, rng = write_balls_scene(tmp_path / "balls", n_frames=3), np.random.default_rng(0)
    if importer == "spacetime_gaussians":
        layouts.write_spacetime(tmp_path / "trained", rows_of(layouts.LITE, rng, 40), None, duration=3)
    else:
        layouts.write_scaffold(tmp_path / "trained", TestScaffold().rows(rng), layouts.scaffold_heads(rng))
    options = ("--format", layout, "--import", importer, "--blank-test-images")
    out, metrics = _checked_and_scored(balls, tmp_path, capsys, *options)
    assert metrics["psnr"] > 5
    picture = read_image(out / "renders" / "7" / "000001.png")
    assert picture.std() > 5  # something is drawn


def test_a_model_that_was_trained_before_is_imported_without_a_command(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    balls = write_balls_scene(tmp_path / "balls", n_frames=3)
    layouts.write_spacetime(tmp_path / "trained", rows_of(layouts.LITE, np.random.default_rng(0), 40), None, duration=3)
    command = _leaves(tmp_path / "trained")
    common = ["--name", "theirs", "--format", "colmap", "--import", "spacetime_gaussians", "--points", str(POINTS)]
    submissions = []
    for name, how in (("run", ["--command", command]), ("taken", ["--trained", str(tmp_path / "trained")])):
        out = tmp_path / name
        assert main(["run-external", str(balls.directory), str(out), *common, *how, "--timing-frames", "1"]) == 0
        submissions.append(Submission.open(out))
    run, taken = submissions
    for path in sorted((tmp_path / "run" / "renders").rglob("*.png")):
        other = tmp_path / "taken" / path.relative_to(tmp_path / "run")
        assert path.read_bytes() == other.read_bytes()
    assert run.record.fit_seconds is not None
    assert (taken.record.fit_seconds, taken.record.peak_memory_bytes) == (None, None)
    assert taken.record.storage_bytes == run.record.storage_bytes
    assert taken.identity.settings["trained"] is True
    assert str(tmp_path) not in (tmp_path / "taken" / "submission.toml").read_text()
    capsys.readouterr()
    for how, said in ((tmp_path / "none", "is not a folder; give the one that the code left its model in"),
                      (tmp_path / "balls", "let the code save its last iteration")):  # fmt: skip
        assert main(["run-external", str(balls.directory), str(tmp_path / "x"), *common, "--trained", str(how)]) == 1
        assert said in capsys.readouterr().err


def _cloud(out: Path) -> Path:
    return out / "point_cloud/iteration_20000/point_cloud.ply"


def _network(out: Path) -> Path:
    return out / "deform/iteration_20000/deform.pth"


class _Code:
    """A pickle that makes a file when it is loaded."""

    def __init__(self, mark: Path) -> None:
        self.mark = mark

    def __reduce__(self) -> tuple:
        return os.mkdir, (str(self.mark),)


def _edit(path: Path, change: object) -> None:
    path.write_bytes(change(path.read_bytes()))  # type: ignore[operator]


def _header(old: bytes, new: bytes) -> object:
    return lambda data: data.replace(old, new, 1)


_NAN = np.array([np.nan], "<f4").tobytes()
_BODY = b"end_header\n"

HOSTILE_CLOUDS = {
    "truncated": (lambda data: data[:-100], r"is cut short: 5 of 6 points are there"),
    "huge count": (_header(b"vertex 6", b"vertex 19999999"), r"is cut short: 6 of 19999999 points"),
    "endless count": (_header(b"vertex 6", b"vertex 99999999999"), r"has 99999999999 points, not 1 to 20000000"),
    "absurd count": (_header(b"vertex 6", b"vertex " + b"9" * 5000), r"begins with element vertex 99.*, not points"),
    "no points": (_header(b"vertex 6", b"vertex 0"), r"has 0 points, not 1 to 20000000"),
    "text": (_header(b"binary_little_endian", b"ascii"), r"is written as text; give the binary"),
    "list": (_header(b"float x", b"list uchar float x"), r"'property list uchar float x' in the header is not known"),
    "twice": (_header(b"float nx", b"float x"), r"has the property x twice"),
    "renamed": (_header(b"float scale_2", b"float scala_2"), r"lacks the property scale_2"),
    "rest": (_header(b"float f_rest_44", b"float other"), r"has 44 properties f_rest_, not 0, 9, 24 or 45"),
    "NaN": (lambda data: data.replace(_BODY, _BODY + _NAN, 1)[:-4], r"x has NaN or infinite entries"),
    "headless": (lambda data: data[20:], r"is no \.ply"),
    "endless": (lambda data: b"ply\n" + b"comment \n" * 10_000, r"is no \.ply"),
    "empty": (lambda data: b"", r"is no \.ply"),
}  # fmt: skip


class TestHostileFiles:
    @pytest.fixture
    def out(self, tmp_path: Path) -> Path:
        rng = np.random.default_rng(0)
        layouts.write_deformable(
            tmp_path / "out", rows_of(layouts.DEFORMABLE, rng), layouts.deform_network(rng, scale=0.0)
        )
        return tmp_path / "out"

    def refused(self, balls: Scene, nerfies: Path, out: Path) -> str:
        with pytest.raises(SplashbenchError) as stop:
            OfficialDeformable3DGS().read(out, nerfies, balls.training())
        return str(stop.value)

    @pytest.mark.parametrize("name", HOSTILE_CLOUDS)
    def test_a_cloud_gives_one_line(self, balls: Scene, nerfies: Path, out: Path, name: str) -> None:
        change, message = HOSTILE_CLOUDS[name]
        _edit(_cloud(out), change)
        said = self.refused(balls, nerfies, out)
        assert said.startswith(str(_cloud(out)))
        assert re.search(message, said)
        assert len(said) < 400

    def test_the_other_byte_order_and_doubles_are_read(self, tmp_path: Path) -> None:
        path = tmp_path / "a.ply"
        head = b"ply\r\nformat binary_big_endian 1.0\r\ncomment made by hand\r\nelement vertex 2\r\n"
        head += b"property double x\r\nproperty uchar y\r\nelement face 1\r\n"
        head += b"property list uchar int v\r\nend_header\r\n"
        body = np.array([(1.5, 7), (-2.0, 8)], [("x", ">f8"), ("y", "u1")]).tobytes()
        path.write_bytes(head + body + b"\x00")
        assert read_point_cloud(path).table("y", "x").tolist() == [[7, 1.5], [8, -2]]

    def test_numbers_that_overflow_are_told_of_at_once(self, balls: Scene, nerfies: Path, out: Path) -> None:
        rng = np.random.default_rng(0)
        layouts.write_ply(_cloud(out), layouts.DEFORMABLE, rows_of(layouts.DEFORMABLE, rng, scale_1=200.0))
        assert "factors of the Gaussians overflow at 0 s" in self.refused(balls, nerfies, out)

    def test_a_pickle_with_code_is_not_run(self, balls: Scene, nerfies: Path, out: Path, tmp_path: Path) -> None:
        mark = tmp_path / "ran"
        weights = _network(out)
        torch.save({"linear.0.weight": _Code(mark)}, weights)
        assert "deform.pth cannot be read as weights alone (UnpicklingError" in self.refused(balls, nerfies, out)
        weights.write_bytes(pickle.dumps(_Code(mark)))
        assert "deform.pth cannot be read as weights alone" in self.refused(balls, nerfies, out)
        assert not mark.exists()

    @pytest.mark.parametrize(
        ("change", "message"),
        [
            ({"linear.3.weight": torch.zeros(256, 255)}, r"linear\.3\.weight is float32 \[256, 255\], not"),
            ({"linear.3.weight": torch.zeros(256, 256, dtype=torch.int64)}, r"linear\.3\.weight is int64 \[256, 256\]"),
            ({"gaussian_warp.bias": torch.tensor([0, np.nan, 0])}, r"gaussian_warp\.bias has NaN or infinite"),
            ({"extra": torch.zeros(1)}, r"has extra, which this network has not"),
            ({"linear.7.bias": None}, r"lacks linear\.7\.bias"),
        ],
    )  # fmt: skip
    def test_weights_that_do_not_fit_are_named(
        self, balls: Scene, nerfies: Path, out: Path, change: dict, message: str
    ) -> None:
        weights = torch.load(_network(out), weights_only=True) | change
        torch.save({name: tensor for name, tensor in weights.items() if tensor is not None}, _network(out))
        said = self.refused(balls, nerfies, out)
        assert said.startswith(str(_network(out)))
        assert re.search(message, said)

    def test_other_files_are_named(self, balls: Scene, nerfies: Path, out: Path) -> None:
        (out / "cfg_args").write_text("__import__('os').mkdir('ran')")
        assert "cfg_args does not begin with Namespace(" in self.refused(balls, nerfies, out)
        torch.save([torch.zeros(3)], _network(out))
        assert "deform.pth holds a list, not tensors by name" in self.refused(balls, nerfies, out)
        _network(out).write_bytes(b"PK\x03\x04 nonsense")
        assert "deform.pth cannot be read as weights alone" in self.refused(balls, nerfies, out)
        _network(out).unlink()
        assert "deform.pth does not exist; let the code save its last iteration" in self.refused(balls, nerfies, out)
        _cloud(out).unlink()
        (out / "point_cloud/iteration_7000/point_cloud.ply").unlink()
        assert "deform.pth does not exist" in self.refused(balls, nerfies, out)
        for folder in (out / "point_cloud").iterdir():
            folder.rmdir()
        assert "point_cloud holds no iteration_<n>" in self.refused(balls, nerfies, out)


def test_arguments_are_read_as_python_prints_them(tmp_path: Path) -> None:
    layouts.write_arguments(
        tmp_path, loader="it's, here='x'", white_background=True, duration=50, offsets=[1.0, 2.0], data_device="cuda"
    )
    arguments = TrainingArguments.read(tmp_path)
    assert arguments.text("source_path") == "/data, set/colmap_0"
    assert arguments.text("loader") == "it's, here='x'"
    assert arguments.number("duration") == 50
    assert arguments.flag("white_background")
    assert not arguments.flag("here")
    assert arguments.text("data_device") == "cuda"


class TestTracedModules:
    def traced(self, path: Path, network: torch.nn.Module, inputs: int) -> None:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)
            torch.jit.save(torch.jit.trace(network.eval(), torch.rand(1, inputs)), path)

    def network(self) -> torch.nn.Sequential:
        return torch.nn.Sequential(
            torch.nn.Linear(32, 16), torch.nn.ReLU(True), torch.nn.Linear(16, 10), torch.nn.Tanh()
        )

    def test_weights_come_out_of_what_torch_traced(self, tmp_path: Path) -> None:
        network = self.network()
        self.traced(tmp_path / "a.pt", network, 32)
        found = read_weights(tmp_path / "a.pt")
        assert sorted(found) == ["0.bias", "0.weight", "2.bias", "2.weight"]
        for name, tensor in network.state_dict().items():
            assert torch.equal(found[name], tensor)

    def rewritten(self, source: Path, path: Path, name: str, data: bytes) -> None:
        with zipfile.ZipFile(source) as old, zipfile.ZipFile(path, "w") as new:
            for entry in old.namelist():
                new.writestr(entry, data if entry.endswith(name) else old.read(entry))

    def test_what_the_program_would_call_is_never_called(self, tmp_path: Path) -> None:
        self.traced(tmp_path / "a.pt", self.network(), 32)
        mark = tmp_path / "ran"
        for number, protocol in enumerate((2, 4)):
            hostile = pickle.dumps(_Code(mark), protocol=protocol)
            path = tmp_path / f"hostile{number}.pt"
            self.rewritten(tmp_path / "a.pt", path, "/data.pkl", hostile)
            with pytest.raises(SplashbenchError, match=r"hostile\d\.pt is TorchScript with more in it than weights"):
                read_weights(path)
        assert not mark.exists()

    @pytest.mark.parametrize(
        ("name", "data", "message"),
        [
            ("data/0", b"\0" * 40, "is damaged (ValueError: an array does not lie in its numbers)"),
            ("/data.pkl", b"\x80\x02.", "is damaged (IndexError"),
            ("/data.pkl", b"", "is damaged (ValueError"),
            ("/data.pkl", b"\x80\x02N.", "is damaged (AttributeError"),
            ("/data.pkl", b"\x80\x02" + b"r\xff\xff\xff\xff" * 3 + b".", "is damaged (IndexError"),
            ("/data.pkl", b"\x80\x02(ios\nmkdir\n.", "is TorchScript with more in it than weights (instruction INST)"),
        ],
    )
    def test_damaged_archives_give_one_line(self, tmp_path: Path, name: str, data: bytes, message: str) -> None:
        self.traced(tmp_path / "a.pt", self.network(), 32)
        self.rewritten(tmp_path / "a.pt", tmp_path / "b.pt", name, data)
        with pytest.raises(SplashbenchError) as stop:
            read_weights(tmp_path / "b.pt")
        assert message in str(stop.value)

    def test_archives_that_unpack_to_more_than_they_hold_are_refused(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr("splashbench.gaussians.official.checkpoint._MAX_BYTES", 1 << 20)
        with zipfile.ZipFile(tmp_path / "a.pt", "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr("a/data.pkl", b"")
            archive.writestr("a/data/0", b"\0" * (2 << 20))
        assert (tmp_path / "a.pt").stat().st_size < 10_000
        with pytest.raises(SplashbenchError, match="holds more than 1 MiB"):
            read_weights(tmp_path / "a.pt")


def test_importers_are_there_and_say_what_they_read() -> None:
    for name in ("deformable_3dgs", "scaffold_4d", "spacetime_gaussians"):
        importer = load_importer(name)
        assert importer.id == name
        assert importer.formats
