"""What a caller meets at the edges: nothing to draw, bad input, repeated runs, several threads, fresh processes."""

from __future__ import annotations

import multiprocessing
import os
import subprocess
import sys
import threading

import numpy as np
import pytest
import torch

from splashbench.errors import SplashbenchError
from splashbench.native.threads import use_threads
from splashbench.render import COLOR, SKIP, counters, cpu, freeze, rasterize, rasterize_arrays
from splashbench.scene.camera import Camera

NAMES = ("means", "factors", "opacities", "colors")


@pytest.fixture
def camera() -> Camera:
    return Camera("1", 170, 90, np.array([[140.0, 0, 85], [0, 140.0, 45], [0, 0, 1]]), np.eye(4))


def scatter(n: int = 500, seed: int = 0, channels: int = 3) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    arrays = (
        rng.normal(size=(n, 3)) * 0.7 + [0, 0, 4],
        rng.normal(size=(n, 3, 3)) * 0.1,
        rng.uniform(0.1, 1, n),
        rng.uniform(size=(n, channels)),
    )
    return [a.astype(np.float32) for a in arrays]


def tensors_of(arrays: list[np.ndarray]) -> list[torch.Tensor]:
    return [torch.tensor(a, requires_grad=True) for a in arrays]


def test_no_gaussians_give_the_background(camera):
    empty = [np.zeros(s, np.float32) for s in ((0, 3), (0, 3, 3), (0,), (0, 3))]
    color, opacity = rasterize_arrays(*empty, camera, background=np.array([0.25, 0.5, 0.75]))
    assert (opacity == 0).all()
    assert (color == np.array([0.25, 0.5, 0.75], np.float32)).all()
    tensors = tensors_of(empty)
    sum(image.sum() for image in rasterize(*tensors, camera)).backward()
    assert tensors[0].grad.shape == (0, 3)


def test_one_pixel():
    camera = Camera("1", 1, 1, np.array([[10.0, 0, 0.5], [0, 10.0, 0.5], [0, 0, 1]]), np.eye(4))
    color, opacity = rasterize_arrays([[0, 0, 5.0]], [np.eye(3)], [0.5], [[0.2, 0.4, 0.6]], camera)
    np.testing.assert_allclose(opacity, [[0.5]], atol=1e-6)
    np.testing.assert_allclose(color, [[[0.1, 0.2, 0.3]]], atol=1e-6)


@pytest.mark.parametrize("mean", [(0, 0, -4), (0, 0, 0.005), (0, 0, 0), (40, 0, 4), (0, -40, 4), (0, 0, 1e30)], ids=str)
def test_gaussians_behind_the_camera_or_beside_the_image_are_not_drawn(camera, mean):
    arrays = [np.array([mean], np.float32), 0.1 * np.eye(3, dtype=np.float32)[None], np.ones(1), np.ones((1, 3))]
    if mean[2] == 1e30:
        arrays[0][0, 0] = 1e30
    tensors = [torch.tensor(a, dtype=torch.float32, requires_grad=True) for a in arrays]
    color, opacity = rasterize(*tensors, camera)
    assert (color == 0).all()
    assert (opacity == 0).all()
    (color.sum() + opacity.sum()).backward()
    assert all((tensor.grad == 0).all() for tensor in tensors)


@pytest.mark.parametrize(("focal", "center"), [(1e9, 85.0), (1.0, 1e9), (1e9, -1e9)])
def test_extreme_cameras_with_skipped_tiles_do_no_harm(focal, center):
    camera = Camera("x", 150, 70, np.array([[focal, 0, center], [0, focal, 35.0], [0, 0, 1]]), np.eye(4))
    modes = np.full((3, 3), COLOR, np.uint8)
    modes[0, 0] = SKIP
    arrays = scatter(200)
    arrays[1][::2] = 0
    color, opacity = rasterize_arrays(*arrays, camera, modes=modes)
    assert np.isfinite(color).all()
    assert (opacity[:32, :64] == 0).all()


@pytest.mark.parametrize("scale", [1e15, 1e30, 3e38])
@pytest.mark.parametrize("which", range(4))
def test_huge_values_do_no_harm(camera, which, scale):
    arrays = scatter(40)
    arrays[which][7] = scale
    tensors = tensors_of(arrays)
    color, opacity = rasterize(*tensors, camera)
    (color.sum() + opacity.sum()).backward()
    assert opacity.shape == (90, 170)
    assert torch.isfinite(opacity).all()


@pytest.mark.parametrize("which", range(4))
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_what_is_not_finite_is_refused_by_name_and_row(camera, which, value):
    arrays = scatter(5000)
    arrays[which][4321] = value
    arrays[which][4700] = value
    message = f"{NAMES[which]} is not finite in 2 of 5000 rows, first in row 4321"
    with pytest.raises(ValueError, match=message):
        rasterize(*tensors_of(arrays), camera)
    with pytest.raises(ValueError, match=message):
        rasterize_arrays(*arrays, camera)


def test_float64_beyond_float32_is_refused(camera):
    arrays = [a.astype(np.float64) for a in scatter(10)]
    arrays[0][3, 1] = 1e300
    with pytest.raises(ValueError, match="means is not finite in 1 of 10 rows, first in row 3"):
        rasterize_arrays(*arrays, camera)


def test_faint_gaussians_are_not_drawn(camera):
    arrays = scatter(50)
    for opacity in (1 / 256, 0.0, -1.0):
        arrays[2][:] = opacity
        assert (rasterize_arrays(*arrays, camera)[1] == 0).all()


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("means", lambda a: a[:, :2], r"means is \[10, 2\], not \[N, 3\]"),
        ("factors", lambda a: a.reshape(10, 9), r"factors is \[10, 9\], not \[10, 3, 3\]"),
        ("opacities", lambda a: a[:, None], r"opacities is \[10, 1\], not \[10\]"),
        ("opacities", lambda a: a[:9], r"opacities is \[9\], not \[10\]"),
        ("colors", lambda a: a[:, 0], r"colors is \[10\], not \[10, C\]"),
        ("colors", lambda a: a[:, :0], r"colors is \[10, 0\], not \[10, C\] with 1 to 32 channels"),
        ("colors", lambda a: np.tile(a, (1, 11)), r"colors is \[10, 33\], not \[10, C\] with 1 to 32 channels"),
    ],
)
def test_wrong_shapes_are_refused_by_name(camera, name, change, message):
    arrays = scatter(10)
    at = NAMES.index(name)
    arrays[at] = change(arrays[at])
    with pytest.raises(ValueError, match=message):
        rasterize_arrays(*arrays, camera)
    with pytest.raises(ValueError, match=message):
        rasterize(*[torch.as_tensor(a) for a in arrays], camera)


@pytest.mark.parametrize("which", range(4))
@pytest.mark.parametrize("dtype", [torch.int64, torch.complex64, torch.bool])
def test_wrong_dtypes_are_refused_by_name(camera, which, dtype):
    tensors = [torch.as_tensor(a) for a in scatter(10)]
    tensors[which] = tensors[which].to(dtype)
    with pytest.raises(TypeError, match=f"{NAMES[which]} is .*not floating point"):
        rasterize(*tensors, camera)
    with pytest.raises(TypeError, match=f"{NAMES[which]} is .*not floating point"):
        rasterize_arrays(*[t.numpy() for t in tensors], camera)


def test_other_wrong_arguments_are_refused_by_name(camera):
    arrays = scatter(10)
    tensors = [torch.as_tensor(a) for a in arrays]
    with pytest.raises(TypeError, match="means is a list, not a torch tensor"):
        rasterize([[0.0, 0, 1]], *tensors[1:], camera)
    with pytest.raises(ValueError, match=r"background is \[90, 171, 3\]"):
        rasterize_arrays(*arrays, camera, background=np.zeros((90, 171, 3)))
    with pytest.raises(ValueError, match="background holds values that are not finite"):
        rasterize_arrays(*arrays, camera, background=np.array([0, np.nan, 0]))
    with pytest.raises(ValueError, match=r"modes is .*make it with"):
        rasterize_arrays(*arrays, camera, modes=np.ones((1, 1), np.uint8))
    with pytest.raises(ValueError, match="modes holds other values"):
        rasterize_arrays(*arrays, camera, modes=np.full((3, 3), 3))
    with pytest.raises(TypeError, match="cameras is a str"):
        rasterize(*tensors, "1")
    with pytest.raises(ValueError, match="backend is 'gpu', not one of auto, cpu, cuda"):
        rasterize(*tensors, camera, backend="gpu")
    for name in ("depth", "compact"):
        for value in (-1, 2, None, "yes"):
            with pytest.raises(TypeError, match=f"{name} is .*, not True or False"):
                rasterize_arrays(*arrays, camera, **{name: value})
    with pytest.raises(TypeError, match="depth is 2"):
        freeze(*arrays, camera, depth=2)
    for frozen in (True, "x", object()):
        with pytest.raises(TypeError, match=r"frozen is a .*, not what splashbench"):
            rasterize_arrays(*arrays, camera, frozen=frozen)
    with pytest.raises(ValueError, match="cameras is empty"):
        rasterize(*tensors, [])
    with pytest.raises(TypeError, match="means holds no dense values"):
        rasterize(tensors[0].to("meta"), *tensors[1:], camera)
    with pytest.raises(TypeError, match="modes cannot be read"):
        rasterize_arrays(*arrays, camera, modes=[[1], [1, 1]])
    with pytest.raises(ValueError, match="background holds values that are not finite"):
        rasterize_arrays(*arrays, camera, background=np.array([np.inf, -np.inf, 0]))
    huge = Camera("8", 2**32 + 64, 1, np.array([[9.0, 0, 4], [0, 9, 0.5], [0, 0, 1]]), np.eye(4))
    with pytest.raises(ValueError, match="camera 8 is"):
        rasterize_arrays(*arrays[:3], None, huge)
    far = Camera("7", 8, 8, np.array([[1e20, 0, 4], [0, 9, 4], [0, 0, 1]]), np.eye(4))
    with pytest.raises(ValueError, match="camera 7 has entries above"):
        rasterize_arrays(*arrays, far)
    skewed = Camera("9", 8, 8, np.array([[9.0, 0.5, 4], [0, 9, 4], [0, 0, 1]]), np.eye(4))
    with pytest.raises(ValueError, match="camera 9 is not a pinhole"):
        rasterize_arrays(*arrays, skewed)


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device here")
def test_asking_for_cuda_without_it_says_what_is_missing(camera):
    with pytest.raises(SplashbenchError, match="CUDA backend cannot be used"):
        rasterize(*[torch.as_tensor(a) for a in scatter(10)], camera, backend="cuda")


def test_any_layout_and_dtype_of_input_gives_the_same_image(camera):
    arrays = scatter(80)
    expected = rasterize_arrays(*arrays, camera)[0]
    double = [np.asfortranarray(a.astype(np.float64)) for a in arrays]
    np.testing.assert_array_equal(rasterize_arrays(*double, camera)[0], expected)
    frozen = [a.copy() for a in arrays]
    for a in frozen:
        a.setflags(write=False)
    np.testing.assert_array_equal(rasterize_arrays(*frozen, camera)[0], expected)
    strided = [torch.as_tensor(np.repeat(a, 2, axis=0))[::2].requires_grad_() for a in arrays]
    color, _ = rasterize(*strided, camera)
    np.testing.assert_array_equal(color.detach().numpy(), expected)
    color.sum().backward()
    assert all(t.grad.shape == t.shape for t in strided)


def test_gradients_come_in_the_inputs_dtypes(camera):
    tensors = [
        torch.tensor(a, dtype=d, requires_grad=True) for a, d in zip(scatter(30), [torch.float64, torch.float16] * 2)
    ]
    rasterize(*tensors, camera)[0].sum().backward()
    assert [t.grad.dtype for t in tensors] == [t.dtype for t in tensors]


def everything(arrays: list[np.ndarray], camera: Camera, channels: int) -> list[bytes]:
    weights = np.random.default_rng(1).normal(size=(90, 170, channels)).astype(np.float32)
    rendering = cpu.forward(*arrays, camera)
    gradients = rendering.backward(weights, weights[..., 0])
    return [a.tobytes() for a in (rendering.color, rendering.opacity, *gradients)]


@pytest.mark.parametrize(("n", "channels"), [(3000, 3), (20000, 3), (3000, 5)])
def test_images_and_gradients_repeat_bit_for_bit_on_any_number_of_threads(camera, n, channels):
    arrays = scatter(n, channels=channels)
    first = everything(arrays, camera, channels)
    assert everything(arrays, camera, channels) == first
    for threads in (1, 2, 3, 7):
        with use_threads(threads):
            assert everything(arrays, camera, channels) == first


def test_several_python_threads_may_render_at_once(camera):
    arrays = scatter(4000)
    expected = everything(arrays, camera, 3)
    results: list[list[bytes]] = []
    workers = [
        threading.Thread(target=lambda: results.extend(everything(arrays, camera, 3) for _ in range(5)))
        for _ in range(4)
    ]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()
    assert len(results) == 20
    assert all(result == expected for result in results)


def _render_in_child(arrays: list[np.ndarray], camera: Camera, queue: multiprocessing.Queue) -> None:
    queue.put(everything(arrays, camera, 3))


@pytest.mark.filterwarnings("ignore:This process .* is multi-threaded:DeprecationWarning")
def test_a_forked_process_renders(camera):
    arrays = scatter(20000)
    with use_threads(3):
        expected = everything(arrays, camera, 3)
        context = multiprocessing.get_context("fork")
        queue = context.Queue()
        process = context.Process(target=_render_in_child, args=(arrays, camera, queue))
        process.start()
        assert queue.get(timeout=60) == expected
        process.join()
        assert process.exitcode == 0


def test_opacity_alone_equals_opacity_with_colors(camera):
    tensors = tensors_of(scatter(200))
    _, opacity = rasterize(*tensors, camera)
    color, alone = rasterize(*tensors[:3], None, camera)
    assert torch.equal(alone, opacity)
    assert color.shape == (90, 170, 0)
    gradients = []
    for image in (opacity, alone):
        tensors[0].grad = None
        image.sum().backward()
        gradients.append(tensors[0].grad)
    assert torch.equal(*gradients)
    assert gradients[0].abs().max() > 0


def test_inputs_changed_in_place_before_the_backward_pass_are_noticed(camera):
    tensors = tensors_of(scatter(20))
    color, _ = rasterize(*tensors, camera)
    with torch.no_grad():
        tensors[0].add_(1)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        color.sum().backward()


BACKGROUNDS = {
    "color": lambda larger: larger[0, 0],
    "image": lambda larger: larger[:90, :170].contiguous(),
    "part of a larger image": lambda larger: larger[5:95, 3:173],
    "doubles": lambda larger: larger[:90, :170].double(),
}


@pytest.mark.parametrize("kind", BACKGROUNDS)
def test_a_background_changed_in_place_leaves_the_gradients_alone(camera, kind):
    gradients = []
    for change in (False, True):
        larger = torch.rand((100, 180, 3), generator=torch.Generator().manual_seed(0))
        tensors, background = tensors_of(scatter(200)), BACKGROUNDS[kind](larger)
        color, _ = rasterize(*tensors, camera, background=background)
        if change:
            background.zero_()
        color.square().sum().backward()
        gradients.append([t.grad for t in tensors])
    for plain, changed in zip(*gradients):
        assert torch.equal(plain, changed)


def test_backward_passes_of_one_rendering_at_once(camera):
    arrays = scatter(4000)
    rendering = cpu.forward(*arrays, camera)
    weights = [np.random.default_rng(i).normal(size=(90, 170, 3)).astype(np.float32) for i in range(2)]
    expected = [rendering.backward(weight, None)[1].copy() for weight in weights]
    wrong: list[int] = []

    def work(which: int) -> None:
        for _ in range(20):
            if not np.array_equal(rendering.backward(weights[which], None)[1], expected[which]):
                wrong.append(which)

    workers = [threading.Thread(target=work, args=(which,)) for which in range(2)]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()
    assert wrong == []


def test_the_backward_pass_can_be_repeated(camera):
    tensors = tensors_of(scatter(200))
    color, _ = rasterize(*tensors, camera)
    color.sum().backward(retain_graph=True)
    first = [t.grad.clone() for t in tensors]
    color.sum().backward()
    for t, once in zip(tensors, first):
        torch.testing.assert_close(t.grad, 2 * once, rtol=0, atol=0)


def test_primitives_and_backends_are_counted(camera):
    counters.reset()
    rasterize_arrays(*scatter(70), camera)
    rasterize_arrays(*scatter(40), camera)
    assert (counters.last, counters.calls(), counters.total()) == (40, 2, 110)
    assert any(name.startswith("cpu (") for name in counters.backends())
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
color, opacity = rasterize(mean, 0.2 * torch.eye(3)[None], torch.ones(1), torch.ones(1, 3), camera)
(torch.randn(200, 200) @ torch.randn(200, 200)).sum()
(color.sum() + opacity[:, :20].sum()).backward()
assert mean.grad.abs().max() > 0
"""


def test_a_fresh_process_with_torch_renders_silently():
    environment = {**os.environ, "PYTHONWARNINGS": "error"}
    done = subprocess.run([sys.executable, "-c", FRESH], capture_output=True, text=True, env=environment, timeout=120)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
