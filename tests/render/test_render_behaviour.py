"""What a caller meets at the edges: nothing to draw, bad numbers, repeated runs, fresh processes."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest
import torch

from splashbench import parallel
from splashbench.render import counters, cpu, rasterize, rasterize_arrays
from splashbench.scene.camera import Camera


@pytest.fixture
def camera() -> Camera:
    return Camera("1", 70, 50, np.array([[60.0, 0, 35], [0, 60.0, 25], [0, 0, 1]]), np.eye(4))


def scatter(n: int = 500, seed: int = 0) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    factors = rng.normal(size=(n, 3, 3)) * 0.1
    arrays = (
        rng.normal(size=(n, 3)) * 0.7 + [0, 0, 4],
        factors @ factors.transpose(0, 2, 1),
        rng.uniform(0.1, 1, n),
        rng.uniform(size=(n, 3)),
    )
    return [a.astype(np.float32) for a in arrays]


def test_no_gaussians_give_the_background(camera):
    empty = [np.zeros(s, np.float32) for s in ((0, 3), (0, 3, 3), (0,), (0, 3))]
    rgb, alpha = rasterize_arrays(*empty, camera, background=np.array([0.25, 0.5, 0.75]))
    assert (alpha == 0).all()
    assert (rgb == np.array([0.25, 0.5, 0.75], np.float32)).all()
    tensors = [torch.tensor(a, requires_grad=True) for a in empty]
    sum(image.sum() for image in rasterize(*tensors, camera)).backward()
    assert tensors[0].grad.shape == (0, 3)


@pytest.mark.parametrize("mean", [(0, 0, -4), (0, 0, 0.005), (0, 0, 0), (40, 0, 4), (0, -40, 4)], ids=str)
def test_gaussians_behind_the_camera_or_beside_the_image_are_not_drawn(camera, mean):
    arrays = [np.array([mean], np.float32), 0.01 * np.eye(3, dtype=np.float32)[None], np.ones(1), np.ones((1, 3))]
    tensors = [torch.tensor(a, dtype=torch.float32, requires_grad=True) for a in arrays]
    rgb, alpha = rasterize(*tensors, camera)
    assert (rgb == 0).all()
    assert (alpha == 0).all()
    (rgb.sum() + alpha.sum()).backward()
    assert all((tensor.grad == 0).all() for tensor in tensors)


@pytest.mark.parametrize("which", range(4))
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_gaussian_that_is_not_finite_is_left_out_alone(camera, which, value):
    arrays = scatter(60)
    keep = np.arange(60) != 30
    expected = rasterize_arrays(*[a[keep] for a in arrays], camera)
    arrays[which][30] = value
    tensors = [torch.tensor(a, requires_grad=True) for a in arrays]
    rgb, alpha = rasterize(*tensors, camera)
    np.testing.assert_array_equal(rgb.detach().numpy(), expected[0])
    np.testing.assert_array_equal(alpha.detach().numpy(), expected[1])
    (rgb.sum() + alpha.sum()).backward()
    assert all(torch.isfinite(t.grad).all() and (t.grad[30] == 0).all() for t in tensors)


def test_faint_gaussians_are_not_drawn(camera):
    arrays = scatter(50)
    arrays[2][:] = 1 / 256
    assert (rasterize_arrays(*arrays, camera)[1] == 0).all()


def test_wrong_shapes_are_refused(camera):
    arrays = scatter(10)
    with pytest.raises(ValueError, match=r"covariances is \(10, 9\)"):
        rasterize_arrays(arrays[0], arrays[1].reshape(10, 9), *arrays[2:], camera)
    with pytest.raises(ValueError, match="tile_mask"):
        rasterize_arrays(*arrays, camera, tile_mask=np.ones((1, 1), bool))
    with pytest.raises(ValueError, match="background"):
        rasterize_arrays(*arrays, camera, background=np.zeros((50, 71, 3)))


def test_any_layout_and_dtype_of_input_gives_the_same_image(camera):
    arrays = scatter(80)
    expected = rasterize_arrays(*arrays, camera)[0]
    double = [np.asfortranarray(a.astype(np.float64)) for a in arrays]
    np.testing.assert_array_equal(rasterize_arrays(*double, camera)[0], expected)
    frozen = [a.copy() for a in arrays]
    for a in frozen:
        a.setflags(write=False)
    np.testing.assert_array_equal(rasterize_arrays(*frozen, camera)[0], expected)


def test_images_and_gradients_repeat_bit_for_bit_on_any_number_of_threads(camera, monkeypatch):
    arrays = scatter(3000)
    weights = np.random.default_rng(1).normal(size=(50, 70, 3)).astype(np.float32)

    def everything() -> list[bytes]:
        rendering = cpu.forward(*arrays, camera)
        gradients = cpu.backward(rendering, weights, weights[..., 0])
        return [a.tobytes() for a in (rendering.rgb, rendering.alpha, *gradients)]

    first = everything()
    assert everything() == first
    for threads in (1, 3):
        monkeypatch.setattr(parallel, "thread_count", lambda threads=threads: threads)
        assert everything() == first


def test_alpha_alone_equals_alpha_with_colours(camera):
    tensors = [torch.tensor(a, requires_grad=True) for a in scatter(200)]
    _, alpha = rasterize(*tensors, camera)
    background = torch.tensor([0.1, 0.2, 0.3])
    rgb, alone = rasterize(*tensors, camera, background=background, colors_needed=False)
    assert torch.equal(alone, alpha)
    assert (rgb == background).all()
    assert not rgb.requires_grad
    gradients = []
    for image in (alpha, alone):
        tensors[0].grad = None
        image.sum().backward()
        gradients.append(tensors[0].grad)
    assert torch.equal(*gradients)
    assert gradients[0].abs().max() > 0


def test_primitives_are_counted_per_forward_call(camera):
    counters.reset()
    rasterize_arrays(*scatter(70), camera)
    rasterize_arrays(*scatter(40), camera)
    assert (counters.last, counters.calls(), counters.total()) == (40, 2, 110)
    counters.reset()
    assert (counters.last, counters.calls(), counters.total()) == (0, 0, 0)


FRESH = """
import sys
import numpy as np
from splashbench.render import rasterize_arrays
assert "torch" not in sys.modules
import torch
from splashbench.render import rasterize
from splashbench.scene.camera import Camera
camera = Camera("1", 40, 30, np.array([[50.0, 0, 20], [0, 50, 15], [0, 0, 1]]), np.eye(4))
mean = torch.tensor([[0.0, 0, 4]], requires_grad=True)
rgb, alpha = rasterize(mean, 0.04 * torch.eye(3)[None], torch.ones(1), torch.ones(1, 3), camera)
(torch.randn(200, 200) @ torch.randn(200, 200)).sum()
(rgb.sum() + alpha[:, :20].sum()).backward()
assert mean.grad.abs().max() > 0
"""


def test_a_fresh_process_with_torch_renders_silently():
    environment = {**os.environ, "PYTHONWARNINGS": "error"}
    done = subprocess.run([sys.executable, "-c", FRESH], capture_output=True, text=True, env=environment, timeout=120)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
