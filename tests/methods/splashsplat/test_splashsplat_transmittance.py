"""How much of what lies behind the liquid shows through it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from splashbench.background.clean_plate import make_clean_plates
from splashbench.files import read_image, write_png
from splashbench.scene import Scene
from splashbench_methods.splashsplat.transmittance import transmittance

BACKDROP = np.random.default_rng(3).integers(30, 220, (200, 200, 3)).astype(np.float64)


def recoloured(directory: Path, share: float, textured: bool = True, covered: bool = False) -> Scene:
    """The scene with liquid that lets `share` of its background through, before noise or one colour. covered: by liquid
    in all frames."""
    scene = Scene.open(directory)
    for name in scene.train:
        camera = scene.cameras[name]
        behind = (
            BACKDROP[: camera.height, : camera.width] if textured else np.full((camera.height, camera.width, 3), 90.0)
        )
        always = np.any([scene.mask(name, t) for t in range(scene.n_frames)], axis=0)
        for t in range(scene.n_frames):
            liquid = always if covered else scene.mask(name, t)
            color = np.array([180.0, 60.0, 40.0]) + 3 * np.random.default_rng(t).standard_normal(behind.shape)
            image = np.where(liquid[..., None], share * behind + (1 - share) * color, behind)
            write_png(scene.image_path(name, t), np.rint(image).clip(0, 255).astype(np.uint8))
            if covered:
                write_png(scene.mask_path(name, t), 255 * liquid.astype(np.uint8))
    return Scene.open(directory)


def found(scene: Scene) -> float:
    training = scene.training()
    return transmittance(training, make_clean_plates(training))


@pytest.mark.parametrize("share", [0.0, 0.3, 0.8])
def test_the_share_is_found(share: float, balls_copy: Path) -> None:
    assert found(recoloured(balls_copy, share)) == pytest.approx(share, abs=0.03)


def test_a_background_without_texture_says_nothing(balls_copy: Path) -> None:
    assert found(recoloured(balls_copy, 0.8, textured=False)) == 0


def test_liquid_that_never_goes_says_nothing(balls_copy: Path) -> None:
    assert found(recoloured(balls_copy, 0.8, covered=True)) == 0


def test_masks_of_one_camera_that_are_all_wrong_do_not_decide(balls_copy: Path) -> None:
    scene = recoloured(balls_copy, 0.0)
    wrong = scene.train[0]
    for t in range(scene.n_frames):
        path = scene.mask_path(wrong, t)
        moved = np.roll(read_image(path), 30, axis=1)
        write_png(path, moved)
    assert found(Scene.open(balls_copy)) < 0.05
