"""Made-up footage with exact answers: five cameras on an arc around a textured table before a textured wall."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from splashbench.background.clean_plate import CleanPlate
from splashbench.scene import Camera, Scene, SceneMeta, write_scene
from splashbench.scene.camera import look_at
from splashbench.selfcalibration.features import Tracks, find_tracks

SIZE = (240, 160)
NAMES = ("1", "2", "3", "4", "5")
#: Scene units: half the table's and the wall's side, and where the wall stands.
HALF, WALL = 2.5, -1.0
TEXELS = 1000


def arc_camera(name: str, degrees: float) -> Camera:
    """A camera 2.5 away, `degrees` around the vertical, that looks at the middle of the table."""
    angle = np.radians(degrees)
    eye = np.array([2.2 * np.sin(angle), 1.2, 2.2 * np.cos(angle)])
    K = np.array([[230.0, 0, 121.3], [0, 230.0, 79.2], [0, 0, 1]])
    return Camera(name, *SIZE, K, look_at(eye, (0, 0.15, -0.2)))


def texture(seed: int) -> NDArray[np.float32]:
    """Smooth noise of several sizes, [TEXELS, TEXELS, 3] in 0 to 1."""
    rng = np.random.default_rng(seed)
    total = np.zeros((TEXELS, TEXELS, 3), np.float32)
    for spread in (3, 6, 14):
        noise = cv2.GaussianBlur(rng.normal(size=total.shape).astype(np.float32), (0, 0), spread)
        total += noise / noise.std()
    return np.clip(0.45 + 0.1 * total, 0.06, 0.92).astype(np.float32)


TABLE, BACK = texture(1), texture(2)


def photograph(camera: Camera, k1: float = 0.0, seed: int = 0) -> NDArray[np.uint8]:
    """What `camera` sees, uint8 [H, W, 3], with a level of noise; k1: distortion of its lens (OpenCV's)."""
    v, u = np.mgrid[: 2 * camera.height, : 2 * camera.width] / 2 + 0.25
    pixels = np.stack([u.ravel(), v.ravel()], axis=1)
    straight = cv2.undistortPoints(pixels[:, None], camera.K, np.array([k1, 0, 0, 0]))[:, 0]
    rays = np.concatenate([straight, np.ones((len(straight), 1))], axis=1) @ camera.w2c[:3, :3]
    eye = camera.center
    down = np.where(rays[:, 1] < -1e-6, -eye[1] / np.minimum(rays[:, 1], -1e-6), np.inf)
    back = np.where(rays[:, 2] < -1e-6, (WALL - eye[2]) / np.minimum(rays[:, 2], -1e-6), np.inf)
    on_table = down < back
    places = eye + rays * np.where(on_table, down, back)[:, None]
    across = np.where(on_table, places[:, 2], places[:, 1])

    def shown(image: NDArray[np.float32]) -> NDArray[np.float32]:
        x, y = (
            ((value + HALF) / (2 * HALF) * TEXELS - 0.5).astype(np.float32).reshape(u.shape)
            for value in (places[:, 0], across)
        )
        return np.asarray(cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT))

    fine = np.where(on_table.reshape(*u.shape, 1), shown(TABLE), shown(BACK))
    image = cv2.resize(fine, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    noise = np.random.default_rng(seed + int(camera.name)).normal(size=image.shape)
    return np.clip(np.rint(255 * image + noise), 0, 255).astype(np.uint8)


def plate_of(camera: Camera, image: NDArray[np.uint8]) -> CleanPlate:
    return CleanPlate(camera, image, np.ones(image.shape[:2], dtype=bool))


def turned(camera: Camera, degrees: float, axis: Sequence[float] = (0, 1, 0)) -> Camera:
    """`camera` turned about its own centre; axis [3] in its own frame."""
    rotation = Rotation.from_rotvec(np.radians(degrees) * np.asarray(axis) / np.linalg.norm(axis)).as_matrix()
    w2c = np.array(camera.w2c)
    w2c[:3] = rotation @ w2c[:3]
    return replace(camera, w2c=w2c)


@pytest.fixture(scope="session")
def cameras() -> dict[str, Camera]:
    return {name: arc_camera(name, degrees) for name, degrees in zip(NAMES, (-32, -16, 0, 16, 32))}


@pytest.fixture(scope="session")
def images(cameras: dict[str, Camera]) -> dict[str, NDArray[np.uint8]]:
    return {name: photograph(camera) for name, camera in cameras.items()}


@pytest.fixture(scope="session")
def plates(cameras: dict[str, Camera], images: dict[str, NDArray[np.uint8]]) -> dict[str, CleanPlate]:
    return {name: plate_of(cameras[name], image) for name, image in images.items()}


@pytest.fixture(scope="session")
def tracks(plates: dict[str, CleanPlate], cameras: dict[str, Camera]) -> Tracks:
    return find_tracks(plates, cameras)


def light(image: NDArray[np.uint8], stops: Sequence[float] | float = 0.0, contrast: float = 1.0) -> NDArray[np.uint8]:
    """`image` as a camera takes it that lets in `stops` more light, of each channel, and has another `contrast`."""
    srgb = image / 255
    linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4) * 2.0 ** np.asarray(stops)
    seen = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 1e-9) ** (1 / 2.4) - 0.055)
    return np.clip(np.rint(255 * np.clip(seen, 0, 1) ** contrast), 0, 255).astype(np.uint8)


class Droplets:
    """Droplets in free flight above the table, all of them by one seed: what a camera sees of them at any time."""

    def __init__(self, count: int, seconds: float, seed: int = 0) -> None:
        rng = np.random.default_rng(seed)
        self.born = rng.uniform(-0.5, seconds, count)
        self.start = rng.uniform([-0.5, 0.2, -0.5], [0.5, 0.5, 0.3], (count, 3))
        self.velocity = rng.normal((0, 1.2, 0), 0.5, (count, 3))
        self.radius = rng.uniform(1.0, 1.6, count)

    def mask(self, camera: Camera, time: float) -> NDArray[np.bool_]:
        """bool [H, W] of `camera` at `time` seconds."""
        age = (time - self.born)[:, None]
        places = self.start + self.velocity * age - [0, 0.5 * 9.81, 0] * age**2
        flying = (age[:, 0] > 0) & (places[:, 1] > 0)
        return discs(camera, places[flying], self.radius[flying])


def discs(camera: Camera, places: NDArray[np.float64], radii: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Discs of `radii` [N] pixels around `places` [N, 3] as `camera` sees them: bool [H, W]."""
    mask = np.zeros((camera.height, camera.width), np.uint8)
    for (u, v), radius in zip(camera.project(places)[0], radii):
        # In sixteenths of a pixel, from the middle of the first one.
        cv2.circle(mask, (round(16 * (u - 0.5)), round(16 * (v - 0.5))), round(16 * radius), 1, -1, cv2.LINE_8, 4)
    return mask.astype(bool)


#: Seconds of a timestep, and how many there are.
STEP, TIMESTEPS = 0.032, 24
#: What is wrong with `wrong`: camera 2 lets in half a stop more, camera 4 is knocked, camera 5 is late.
STOPS, KNOCKED_AT, KNOCKED_BY, LATE = 0.5, 14, 0.6, 0.010


@pytest.fixture(scope="session")
def wrong_directory(tmp_path_factory: pytest.TempPathFactory, cameras: dict[str, Camera]) -> Path:
    """A scene whose cameras are not as it says; read-only. The test view "6" is right."""
    directory = tmp_path_factory.mktemp("wrong") / "wrong"
    every = {**cameras, "6": arc_camera("6", 8)}
    droplets = Droplets(40, TIMESTEPS * STEP)

    def frames() -> Iterator[tuple[str, int, NDArray[np.uint8], NDArray[np.bool_]]]:
        for name, camera in every.items():
            knocked = turned(camera, KNOCKED_BY)
            still = photograph(camera), photograph(knocked)
            for t in range(TIMESTEPS):
                after = name == "4" and t >= KNOCKED_AT
                mask = droplets.mask(knocked if after else camera, t * STEP + (LATE if name == "5" else 0))
                image = np.where(mask[..., None], np.array([40, 70, 200], np.uint8), still[after])
                yield name, t, light(image, STOPS) if name == "2" else image, mask

    write_scene(
        directory,
        cameras=every,
        train=NAMES,
        test=("6",),
        n_frames=TIMESTEPS,
        frames=frames(),
        meta=SceneMeta(name="wrong", times=[STEP * t for t in range(TIMESTEPS)], gravity=(0, -1, 0)),
        container_masks={name: np.ones((camera.height, camera.width), bool) for name, camera in every.items()},
    )
    return directory


@pytest.fixture(scope="session")
def wrong(wrong_directory: Path) -> Scene:
    return Scene.open(wrong_directory)
