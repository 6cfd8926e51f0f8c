"""Training targets at half their size: the same view of the same liquid, with pixels twice as large."""

from typing import Any

import numpy as np
import pytest
import torch

from splashbench.scene.camera import Camera, look_at
from splashbench_methods.splashsplat.appearance import coarse as coarse_module
from splashbench_methods.splashsplat.appearance.coarse import (
    halved_photograph,
    set_smaller_backgrounds,
    with_smaller,
)
from splashbench_methods.splashsplat.appearance.photographs import (
    Deferred,
    ReadAhead,
    Shelf,
    packed,
    read_now,
)
from splashbench_methods.splashsplat.appearance.targets import TrainingTarget, release_backgrounds, set_backgrounds
from splashbench_methods.splashsplat.kernel.window_loss import WindowPhotograph

SIZE = 24


def camera(width: int, height: int) -> Camera:
    K = np.array([[40.0, 0, width / 2 + 1.5], [0, 44.0, height / 2 - 0.5], [0, 0, 1]])
    return Camera("1", width, height, K, look_at([0, 0, -3.0]))


def target(width: int = SIZE, height: int = SIZE, top: int = 4, left: int = 4, rows: int = 12, columns: int = 10):
    """A window of [height, width] pixels whose photograph is brighter to the right, its right half liquid."""
    ramp = torch.arange(columns, dtype=torch.float32).mul(10).expand(rows, columns)
    mask = torch.zeros(rows, columns, dtype=torch.bool)
    mask[:, columns // 2 :] = True
    return TrainingTarget(
        frame=3,
        fraction=0.25,
        camera=camera(width, height),
        eye=torch.zeros(3),
        photograph=WindowPhotograph(ramp[..., None].repeat(1, 1, 3).to(torch.uint8), mask, top, left),
        background=torch.arange(height * width * 3, dtype=torch.float32).reshape(height, width, 3) / 1e4,
        area=200.0,
        hidden=torch.tensor([0, 255], dtype=torch.uint8),
        wall=torch.ones(height, width) * torch.arange(width) / width,
    )


def halved(fine: TrainingTarget) -> TrainingTarget:
    """`fine`, whose window is the whole image, at half its size."""
    assert fine.wall is not None
    with_smaller([fine], {"1": fine.background.numpy()}, {"1": fine.wall.numpy()})
    assert fine.coarse is not None
    return fine.coarse


def test_a_point_is_seen_at_half_the_pixel() -> None:
    fine = target(width=25, height=23)
    coarse = halved(fine)
    points = np.random.default_rng(0).uniform(-0.5, 0.5, size=(20, 3))
    np.testing.assert_allclose(coarse.camera.project(points)[0], fine.camera.project(points)[0] / 2)
    assert (coarse.camera.width, coarse.camera.height) == (13, 12)
    assert tuple(coarse.background.shape) == (12, 13, 3)
    assert coarse.wall is not None
    assert tuple(coarse.wall.shape) == (12, 13)


def test_pixels_are_means_of_four_and_a_mask_is_their_majority() -> None:
    coarse = halved(target())
    photograph = read_now(coarse.photograph)
    assert (photograph.top, photograph.left) == (2, 2)
    assert photograph.image[0, :, 0].tolist() == [5, 25, 45, 65, 85]
    # Columns 5 to 9 are liquid: of the third pair, 4 and 5, half is.
    assert photograph.mask[0].tolist() == [False, False, True, True, True]
    fine = target()
    torch.testing.assert_close(coarse.background[3, 5], fine.background[6:8, 10:12].mean(dim=(0, 1)))
    assert coarse.wall is not None
    assert fine.wall is not None
    torch.testing.assert_close(coarse.wall[3, 5], fine.wall[6:8, 10:12].mean())
    assert (coarse.area, coarse.frame, coarse.fraction) == (50.0, 3, 0.25)
    assert coarse.hidden is fine.hidden or torch.equal(coarse.hidden, fine.hidden)


@pytest.mark.parametrize(("top", "left", "rows", "columns"), [(5, 4, 12, 10), (4, 5, 11, 9), (5, 5, 12, 11)])
def test_a_box_at_an_odd_pixel_is_grown_to_even_ones(top: int, left: int, rows: int, columns: int) -> None:
    fine = target(top=top, left=left, rows=rows, columns=columns)
    photograph = read_now(halved(fine).photograph)
    whole, mask = np.zeros((SIZE, SIZE)), np.zeros((SIZE, SIZE))
    whole[fine.photograph.box] = fine.photograph.image[..., 0].numpy()
    mask[fine.photograph.box] = fine.photograph.mask.numpy()
    blocks = mask.reshape(SIZE // 2, 2, SIZE // 2, 2).mean(axis=(1, 3))
    found = np.zeros((SIZE // 2, SIZE // 2), bool)
    found[photograph.box] = photograph.mask.numpy()
    np.testing.assert_array_equal(found, blocks >= 0.5)
    # Where the box holds all four, the image is their mean.
    means = whole.reshape(SIZE // 2, 2, SIZE // 2, 2).mean(axis=(1, 3))
    inner = tuple(slice(side.start + 1, side.stop - 1) for side in photograph.box)
    np.testing.assert_allclose(photograph.image[1:-1, 1:-1, 0].numpy(), means[inner], atol=0.51)
    assert photograph.image.is_contiguous()
    assert photograph.mask.is_contiguous()


def test_windows_of_one_image_share_its_half() -> None:
    whole = np.random.default_rng(1).random((31, 40, 3)).astype(np.float32)
    wall = np.random.default_rng(2).random((31, 40)).astype(np.float32)
    targets = []
    for x, y in ((2, 4), (10, 0)):
        made = target(width=20, height=21 if y else 23)
        made.corner = (x, y)
        made.background = torch.from_numpy(whole)[y : y + made.camera.height, x : x + 20]
        targets.append(made)
    with_smaller(targets, {"1": whole}, {"1": wall})
    storages = set()
    for made in targets:
        coarse = made.coarse
        assert coarse is not None
        assert coarse.wall is not None
        x, y = made.corner
        assert tuple(coarse.background.shape) == (coarse.camera.height, coarse.camera.width, 3)
        block = whole[y + 2 : y + 4, x + 6 : x + 8].mean(axis=(0, 1))
        np.testing.assert_allclose(coarse.background[1, 3].numpy(), block, rtol=1e-6)
        np.testing.assert_allclose(float(coarse.wall[1, 3]), wall[y + 2 : y + 4, x + 6 : x + 8].mean(), rtol=1e-6)
        storages.add(coarse.background.untyped_storage().data_ptr())
    assert len(storages) == 1
    # Another background is halved in the same way.
    expected = [made.coarse.background.clone() for made in targets if made.coarse]
    with_smaller(targets, {"1": np.zeros_like(whole)}, {"1": wall})
    set_smaller_backgrounds(targets, [("1", whole)])
    for made, wanted in zip(targets, expected, strict=True):
        assert made.coarse is not None
        assert torch.equal(made.coarse.background, wanted)


def test_photographs_beyond_the_room_are_read_again_each_time() -> None:
    read = []

    def reading(n: int):
        def read_one() -> WindowPhotograph:
            read.append(n)
            return WindowPhotograph(
                torch.full((4, 5, 3), n, dtype=torch.uint8), torch.ones(4, 5, dtype=torch.bool), 0, 0
            )

        return read_one

    # A photograph has 80 bytes: with room for 100, two are kept.
    shelf = Shelf(room=100)
    photographs = [Deferred(reading(n)) if shelf.full else shelf.keep(reading(n)()) for n in range(4)]
    assert read == [0, 1]
    reader = ReadAhead()
    for n in (2, 0, 3, 2):
        assert int(reader.get(photographs[n]).image[0, 0, 0]) == n
    assert read == [0, 1, 2, 3, 2]
    reader.prepare(photographs[3])
    assert int(reader.get(photographs[3]).image[0, 0, 0]) == 3
    # What was prepared and is not wanted after all does no harm.
    reader.prepare(photographs[3])
    assert int(reader.get(photographs[2]).image[0, 0, 0]) == 2
    reader.prepare(photographs[0])
    reader.close()
    assert sorted(read[5:]) == [2, 3, 3]
    assert int(read_now(photographs[2]).image[0, 0, 0]) == 2


def test_the_coarsest_are_the_coarse_ones_halved() -> None:
    made = target(width=24, height=24)
    before = read_now(made.photograph)
    coarse = halved(made)
    coarsest = coarse.coarse
    assert coarsest is not None
    assert coarsest.coarse is None
    assert (coarsest.camera.width, coarsest.camera.height) == (6, 6)
    assert coarsest.area == made.area / 16
    points = np.random.default_rng(0).uniform(-0.5, 0.5, size=(20, 3))
    np.testing.assert_allclose(coarsest.camera.project(points)[0], made.camera.project(points)[0] / 4)
    # It is made of the coarse one whenever it is to teach.
    assert isinstance(coarsest.photograph, Deferred)
    again = read_now(coarsest.photograph)
    expected = halved_photograph(halved_photograph(before))
    assert torch.equal(again.image, expected.image)
    assert torch.equal(again.mask, expected.mask)
    block = made.background[4:8, 8:12].mean(dim=(0, 1))
    torch.testing.assert_close(coarsest.background[1, 2], block)
    behind = torch.rand(24, 24, 3)
    set_smaller_backgrounds([made], [("1", behind.numpy())])
    torch.testing.assert_close(coarsest.background[1, 2], behind[4:8, 8:12].mean(dim=(0, 1)))
    torch.testing.assert_close(coarse.background[1, 2], behind[2:4, 4:6].mean(dim=(0, 1)))


def test_a_colour_behind_everything_stays_one() -> None:
    made = target()
    made.background = torch.tensor([0.1, 0.2, 0.3])
    with_smaller([made], {"1": np.array([0.1, 0.2, 0.3], np.float32)}, {"1": None})
    assert made.coarse is not None
    assert made.coarse.background.tolist() == pytest.approx([0.1, 0.2, 0.3])
    assert made.coarse.wall is None


def test_a_coarse_pixel_is_the_rounded_mean_of_four() -> None:
    rng = np.random.default_rng(4)
    pixels = rng.integers(0, 256, (64, 64, 3), dtype=np.uint8)
    mask = rng.random((64, 64)) < 0.5
    found = halved_photograph(WindowPhotograph(torch.from_numpy(pixels), torch.from_numpy(mask), top=2, left=4))
    blocks = pixels.astype(float).reshape(32, 2, 32, 2, 3).mean(axis=(1, 3))
    np.testing.assert_array_equal(found.image.numpy(), np.round(blocks))
    np.testing.assert_array_equal(found.mask.numpy(), mask.reshape(32, 2, 32, 2).sum(axis=(1, 3)) >= 2)
    assert (found.top, found.left) == (1, 2)


def test_coarse_photographs_beyond_the_room_are_made_again(monkeypatch: pytest.MonkeyPatch) -> None:
    made = []

    def counted(photograph: WindowPhotograph) -> WindowPhotograph:
        made.append(photograph)
        return halved_photograph(photograph)

    monkeypatch.setattr(coarse_module, "halved_photograph", counted)
    photograph = halved(target()).photograph
    kept = read_now(photograph)
    read_now(photograph)
    assert len(made) == 1
    monkeypatch.setattr(coarse_module, "Shelf", lambda room=0: Shelf(room=0))
    later = halved(target()).photograph
    assert len(made) == 1
    for count in (2, 3):
        again = read_now(later)
        assert len(made) == count
        assert torch.equal(again.image, kept.image)
        assert torch.equal(again.mask, kept.mask)
        assert (again.top, again.left) == (kept.top, kept.left)


@pytest.mark.parametrize("room", [0, 1 << 20])
def test_large_photographs_are_looked_at_once_and_in_their_order(room: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(coarse_module, "Shelf", lambda most=room: Shelf(most))
    monkeypatch.setattr(coarse_module, "_AT_ONCE", 3)
    targets, read = [target() for _ in range(8)], []
    for number, each in enumerate(targets):
        photograph = read_now(each.photograph)
        each.photograph = Deferred(lambda photograph=photograph, number=number: read.append(number) or photograph)

    class Look:
        def __init__(self) -> None:
            self.added: list[int] = []

        def at(self, seen: TrainingTarget, photograph: WindowPhotograph) -> int:
            assert photograph.mask.shape == (12, 10)
            return next(number for number, each in enumerate(targets) if each is seen)

        def add(self, seen: int) -> None:
            self.added.append(seen)

    look: Any = Look()
    with_smaller(targets, {"1": targets[0].background.numpy()}, {"1": None}, look)
    assert look.added == list(range(8))
    assert sorted(read) == list(range(8))


@pytest.mark.parametrize("shape", [(1, 1), (3, 5), (8, 8), (7, 16), (0, 4)])
def test_a_mask_is_kept_in_bits(shape: tuple[int, int]) -> None:
    rng = np.random.default_rng(5)
    image = torch.from_numpy(rng.integers(0, 256, (*shape, 3), dtype=np.uint8))
    made = WindowPhotograph(image, torch.from_numpy(rng.random(shape) < 0.5), top=3, left=6)
    kept = packed(made)
    made_again = kept.read()
    assert made_again.image is image
    assert torch.equal(made_again.mask, made.mask)
    assert made_again.mask.dtype == torch.bool
    assert made_again.mask.is_contiguous()
    assert made_again.box == made.box
    # Whoever changes what was read changes no later reading.
    made_again.mask.logical_not_()
    assert torch.equal(kept.read().mask, made.mask)


def test_backgrounds_are_let_go_of_until_there_are_others() -> None:
    made = target()
    fine = made.background.numpy().copy()
    coarse = halved(made)
    assert coarse.coarse is not None
    release_backgrounds([made])
    assert made.background.numel() == 3
    coarse.background, coarse.coarse.background = torch.zeros(3), torch.zeros(3)
    set_smaller_backgrounds([made], iter([("2", fine), ("1", fine)]))
    assert made.background.numel() == 3
    assert tuple(coarse.background.shape) == (12, 12, 3)
    assert tuple(coarse.coarse.background.shape) == (6, 6, 3)
    set_backgrounds([made], iter([("2", np.zeros_like(fine)), ("1", fine)]))
    np.testing.assert_array_equal(made.background.numpy(), fine)
