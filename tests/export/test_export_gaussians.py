"""Files of 3D Gaussians, read by trimesh and drawn: what a viewer shows is what the method shows."""

from __future__ import annotations

from copy import copy
from pathlib import Path

import numpy as np
import pytest

from splashbench.errors import SplashbenchError
from splashbench.export import export_gaussians, place
from splashbench.export.coloured import Coloured
from splashbench.export.gaussian_files import write_gaussians
from splashbench.export.harmonics import fit_harmonics, viewpoints
from splashbench.render import rasterize_arrays
from splashbench.replay import Reconstruction
from splashbench.scene import Camera, Gaussians

from .conftest import columns, read_points, showing
from .exact_balls import FAINT, PER_BALL, SKY, ExactBalls

STANDARD = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
SHAPE = ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]


def gaussians_of(points: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Means [N, 3], covariances [N, 3, 3] and opacities [N] of a file, as the published code takes them."""
    w, x, y, z = columns(points, "rot_0", "rot_1", "rot_2", "rot_3").T
    turns = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    ).transpose(2, 0, 1)
    factors = turns * np.exp(columns(points, "scale_0", "scale_1", "scale_2"))[:, None]
    return columns(points, "x", "y", "z"), factors @ factors.transpose(0, 2, 1), 1 / (1 + np.exp(-points["opacity"]))


def drawn(points: dict[str, np.ndarray], camera: Camera, background: np.ndarray) -> np.ndarray:
    """The view of `camera` of a file of degree 0 or 1, drawn on `background`."""
    means, covariances, opacities = gaussians_of(points)
    values, vectors = np.linalg.eigh(covariances)
    factors = vectors * np.sqrt(np.maximum(values, 0))[:, None]
    x, y, z = ((means - camera.center) / np.linalg.norm(means - camera.center, axis=1, keepdims=True)).T
    colors = 0.5 + 0.28209479177387814 * columns(points, "f_dc_0", "f_dc_1", "f_dc_2")
    if "f_rest_0" in points:
        for channel in range(3):
            along = columns(points, *(f"f_rest_{3 * channel + k}" for k in range(3)))
            colors[:, channel] += 0.4886025119029199 * (-y * along[:, 0] + z * along[:, 1] - x * along[:, 2])
    image, _ = rasterize_arrays(
        *(array.astype(np.float32) for array in (means, factors, opacities, np.maximum(colors, 0))),
        camera,
        background=background,
    )
    return np.clip(image, 0, 1)


def psnr(image: np.ndarray, truth: np.ndarray) -> float:
    return float(-10 * np.log10(np.mean((image - truth) ** 2)))


@pytest.fixture(scope="module")
def folder(known: Reconstruction, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("exports") / "ply"
    export_gaussians(known, out)
    return out


def test_the_files_have_the_published_properties_in_order(folder: Path, known: Reconstruction) -> None:
    files = sorted((folder / "frames").iterdir())
    assert [path.name for path in files] == [f"frame{t:04d}.ply" for t in range(1, len(known.times) + 1)]
    for degree, count in ((0, 0), (1, 9), (2, 24), (3, 45)):
        out = folder.parent / f"degree{degree}"
        export_gaussians(known, out, known.times[3:4], degree=degree)
        path = out / "frames" / "frame0001.ply"
        head = path.read_bytes().partition(b"end_header\n")[0].decode().splitlines()
        assert head[:2] == ["ply", "format binary_little_endian 1.0"]
        names = [line.split()[2] for line in head if line.startswith("property float")]
        assert names == [*STANDARD, *(f"f_rest_{i}" for i in range(count)), *SHAPE]


def test_gaussians_come_back_as_they_were(folder: Path, known: Reconstruction) -> None:
    for t in (2, 7):
        points = read_points(folder / "frames" / f"frame{t + 1:04d}.ply")
        assert all(np.isfinite(values).all() for values in points.values())  # flat ones and opacities of 1 as well
        liquid, floor = known.gaussians(known.times[t]), known.static_gaussians()
        assert liquid is not None
        assert floor is not None
        kept = np.arange(3 * PER_BALL) % PER_BALL != FAINT
        means, covariances, opacities = gaussians_of(points)
        assert len(means) == kept.sum() + len(floor)
        parts = (liquid.kept(kept), floor)
        np.testing.assert_allclose(means, np.concatenate([part.means for part in parts]), atol=1e-6)
        np.testing.assert_allclose(covariances, np.concatenate([part.covariances for part in parts]), atol=1e-8)
        np.testing.assert_allclose(opacities, np.concatenate([part.opacities for part in parts]), atol=1e-5)


def test_a_file_shows_what_the_method_shows(folder: Path, known: Reconstruction) -> None:
    for t in (1, 6):
        points = read_points(folder / "frames" / f"frame{t + 1:04d}.ply")
        for name in known.cameras:
            truth = known.render(name, known.times[t]).rgb
            assert psnr(drawn(points, known.cameras[name], SKY), truth) > 45
    plain = folder.parent / "plain"
    export_gaussians(known, plain, known.times[6:7], degree=0)
    view = drawn(read_points(plain / "frames" / "frame0001.ply"), known.cameras["1"], SKY)
    assert 20 < psnr(view, known.render("1", known.times[6]).rgb) < 40  # the sheen is lost


def test_the_colour_behind_is_told_or_drawn(folder: Path, known: Reconstruction) -> None:
    told = "#" + "".join(f"{round(float(value) * 255):02x}" for value in SKY)
    manifest = export_gaussians(known, folder.parent / "told", known.times[6:7])
    assert manifest.options["background_color"] == told
    assert any(told in note for note in manifest.notes)
    truth, black = known.render("3", known.times[6]).rgb, np.zeros(3, np.float32)
    points = read_points(folder.parent / "told" / "frames" / "frame0001.ply")
    assert psnr(drawn(points, known.cameras["3"], black), truth) < 15
    manifest = export_gaussians(known, folder.parent / "sphere", known.times[6:7], backdrop=True)
    assert not any(told in note for note in manifest.notes)
    points = read_points(folder.parent / "sphere" / "frames" / "frame0001.ply")
    assert psnr(drawn(points, known.cameras["3"], black), truth) > 35


def test_parts(known: Reconstruction, tmp_path: Path) -> None:
    liquid = export_gaussians(known, tmp_path / "liquid", known.times[:3], part="liquid")
    drawn_ones = 3 * (PER_BALL - 1)
    assert liquid.counts == {"liquid": [0, drawn_ones, drawn_ones]}
    assert len(read_points(tmp_path / "liquid" / "frames" / "frame0002.ply")["x"]) == drawn_ones
    # An instant without liquid is a valid file of nothing.
    head, _, body = (tmp_path / "liquid" / "frames" / "frame0001.ply").read_bytes().partition(b"end_header\n")
    assert b"element vertex 0\n" in head
    assert body == b""
    background = export_gaussians(known, tmp_path / "background", part="background")
    assert background.files == ["background.ply"]
    assert sorted(path.name for path in (tmp_path / "background").iterdir()) == ["background.ply", "manifest.json"]
    assert len(read_points(tmp_path / "background" / "background.ply")["x"]) == 400


def test_a_turned_and_scaled_file_shows_the_same_from_the_turned_camera(known: Reconstruction, tmp_path: Path) -> None:
    placement = place(known, up="z", gravity=(0.3, -1.0, 0.2))
    placement = type(placement)(placement.rotation, 2.5, "scene units", "z")
    export_gaussians(known, tmp_path / "out", known.times[5:6], placement)
    points = read_points(tmp_path / "out" / "frames" / "frame0001.ply")
    view = drawn(points, placement.camera(known.cameras["4"]), SKY)
    assert psnr(view, known.render("4", known.times[5]).rgb) > 45


def test_methods_without_gaussians_say_what_else_there_is(oracle: Path, known: Reconstruction, tmp_path: Path) -> None:
    from splashbench.replay import load

    with pytest.raises(SplashbenchError, match="it keeps no model of oracle to ask; export its particles"):
        export_gaussians(load(oracle), tmp_path / "out")

    class NoFloor(ExactBalls):
        def static_gaussians(self, eye: np.ndarray) -> Gaussians | None:  # type: ignore[override]
            return None

    alone = showing(known, NoFloor(known.times))
    assert "keeps no background" in " ".join(export_gaussians(alone, tmp_path / "all", known.times[3:4]).notes)
    with pytest.raises(SplashbenchError, match="no Gaussians of a background"):
        export_gaussians(alone, tmp_path / "none", part="background")
    assert not (tmp_path / "none").exists()


def test_a_background_out_of_one_set_is_told(known: Reconstruction, tmp_path: Path) -> None:
    opened = showing(known, known.fitted)
    submission = copy(known.submission)
    submission.identity = submission.identity.model_copy(update={"mixed": True})
    opened.submission = submission
    assert any("in one set of Gaussians" in note for note in export_gaussians(opened, tmp_path / "out").notes)
    assert not any("one set" in note for note in export_gaussians(known, tmp_path / "other").notes)


def test_gaussians_that_change_with_the_viewpoint_are_those_of_one(known: Reconstruction, tmp_path: Path) -> None:
    class Fickle(ExactBalls):
        def gaussians(self, time: float, eye: np.ndarray) -> Gaussians:
            return super().gaussians(time, eye).kept(np.arange(3 * PER_BALL) > (20 if eye[0] > 0.1 else 10))

    manifest = export_gaussians(showing(known, Fickle(known.times)), tmp_path / "out", known.times[3:4])
    assert any("change with the viewpoint" in note for note in manifest.notes)
    assert not columns(
        {k: v[:50] for k, v in read_points(tmp_path / "out/frames/frame0001.ply").items()}, "f_rest_0"
    ).any()


@pytest.mark.parametrize("name", ["means", "factors", "opacities", "colors"])
def test_what_is_not_finite_is_refused(known: Reconstruction, tmp_path: Path, name: str) -> None:
    class Broken(ExactBalls):
        def gaussians(self, time: float, eye: np.ndarray) -> Gaussians:
            found = super().gaussians(time, eye)
            if time > 0.2:
                getattr(found, name).flat[5] = np.nan
            return found

    with pytest.raises(SplashbenchError, match=f"have {name} that are not finite"):
        export_gaussians(showing(known, Broken(known.times)), tmp_path / "out")
    assert list(tmp_path.iterdir()) == []


def test_harmonics_of_degree_one_are_found_where_cameras_look_from() -> None:
    rng = np.random.default_rng(1)
    means = rng.normal(scale=0.1, size=(40, 3))
    slopes, tints = rng.normal(scale=0.1, size=(40, 3, 3)), rng.uniform(0.3, 0.7, (40, 3))
    cameras = [np.array([np.sin(a), 0.4, np.cos(a)]) * 2 for a in np.radians([-40, -15, 10, 40])]
    views = viewpoints(cameras, np.zeros(3))
    assert views.weights.sum() == pytest.approx(1)
    np.testing.assert_allclose(views.places[:4], cameras)

    def seen(eye: np.ndarray) -> np.ndarray:
        arms = means - eye
        return tints + np.einsum("nk,nkc->nc", arms / np.linalg.norm(arms, axis=1, keepdims=True), slopes)

    found = fit_harmonics(means, np.stack([seen(eye) for eye in views.places]), views, 1)
    for eye in (cameras[1], np.array([0.2, 0.8, 1.9])):
        arms = means - eye
        x, y, z = (arms / np.linalg.norm(arms, axis=1, keepdims=True)).T
        shape = np.stack([np.full_like(x, 0.282095), -0.488603 * y, 0.488603 * z, -0.488603 * x], axis=1)
        np.testing.assert_allclose(0.5 + np.einsum("nk,nkc->nc", shape, found), seen(eye), atol=0.01)


def test_viewpoints_of_any_rig() -> None:
    for cameras in (
        [np.array([0.0, 0, 2])],
        [np.zeros(3)],
        [np.array([0.0, 0, 2]), np.array([0.0, 0, -2])],
        list(np.random.default_rng(0).normal(size=(30, 3))),
    ):
        views = viewpoints(cameras, np.zeros(3))
        assert np.isfinite(views.places).all()
        assert len(views.places) <= len(cameras) + 2 * 16 + 3


def test_degenerate_gaussians_stay_finite(tmp_path: Path) -> None:
    factors = np.zeros((4, 3, 3), np.float32)
    factors[1, 0, 0] = 1e-3  # a needle
    factors[2] = [[1, 0, 0], [0, 1, 0], [0, 0, 1e-30]]
    factors[3] = np.diag([-1.0, 1.0, 1.0])  # a mirror
    odd = Gaussians(np.zeros((4, 3), np.float32), factors, np.array([0, 1, 1, 0.5], np.float32), np.zeros((4, 3)))
    write_gaussians(tmp_path / "odd.ply", [Coloured.plain(odd.kept(odd.opacities > 0), 1)])
    points = read_points(tmp_path / "odd.ply")
    assert all(np.isfinite(values).all() for values in points.values())
    _, covariances, opacities = gaussians_of(points)
    np.testing.assert_allclose(covariances[1:], [np.diag([1, 1, 0]), np.eye(3)], atol=1e-6)
    np.testing.assert_allclose(opacities, [1, 1, 0.5], atol=1e-5)


def test_wrong_options_are_told(known: Reconstruction, tmp_path: Path) -> None:
    for options in ({"part": "some"}, {"degree": 4}, {"part": "liquid", "backdrop": True}):
        with pytest.raises(SplashbenchError):
            export_gaussians(known, tmp_path / "out", **options)  # type: ignore[arg-type]
