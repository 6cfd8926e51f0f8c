"""LPIPS against the published values of the reference implementation; null with a reason without weights."""

from pathlib import Path

import numpy as np
import pytest

from splashbench.errors import SplashbenchError
from splashbench.files import read_image
from splashbench.score.image import lpips as module
from splashbench.score.image.lpips import Lpips, load_lpips


@pytest.fixture
def weights_folder(test_data: Path) -> Path:
    folder = test_data / "weights"
    if not (folder / "lpips_alex_v0.1.npz").is_file():
        pytest.skip("SPLASHBENCH_TEST_DATA holds no weights/lpips_alex_v0.1.npz")
    return folder


@pytest.fixture
def metric(weights_folder: Path) -> Lpips:
    loaded, reason = load_lpips(weights_folder / "lpips_alex_v0.1.npz")
    assert loaded is not None, reason
    return loaded


@pytest.mark.parametrize(("name", "expected"), [("ex_p0.png", 0.721881), ("ex_p1.png", 0.137566)])
def test_published_example_pairs(metric: Lpips, weights_folder: Path, name: str, expected: float) -> None:
    reference, other = (read_image(weights_folder / file) / 255.0 for file in ("ex_ref.png", name))
    assert metric(reference, other) == pytest.approx(expected, abs=2e-6)
    assert metric(reference, reference) == 0.0


def test_weights_are_found_through_the_environment(weights_folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SPLASHBENCH_LPIPS_WEIGHTS", str(weights_folder / "lpips_alex_v0.1.npz"))
    loaded, _ = load_lpips()
    assert loaded is not None
    assert loaded.digest == module.WEIGHTS_SHA256


def test_weights_from_an_installed_package_and_torch_hub_are_the_same(
    weights_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import torch

    arrays = np.load(weights_folder / "lpips_alex_v0.1.npz")
    heads = {f"lin{i}.model.1.weight": torch.from_numpy(arrays[f"lin{i}"]).reshape(1, -1, 1, 1) for i in range(5)}
    layers = {
        f"features.{layer}.{part}": torch.from_numpy(arrays[f"conv{i}.{part}"])
        for i, layer in enumerate((0, 3, 6, 8, 10), start=1)
        for part in ("weight", "bias")
    }
    package = tmp_path / "site" / "lpips"
    (package / "weights" / "v0.1").mkdir(parents=True)
    (package / "__init__.py").write_text("raise ImportError('no torchvision here')")
    torch.save(heads, package / "weights" / "v0.1" / "alex.pth")
    monkeypatch.syspath_prepend(tmp_path / "site")
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "hub_home"))
    missing, reason = load_lpips()
    assert missing is None
    assert "torch.hub" in reason
    checkpoints = Path(torch.hub.get_dir(), "checkpoints")
    checkpoints.mkdir(parents=True)
    torch.save(layers, checkpoints / "alexnet-owt-7be5be79.pth")
    loaded, _ = load_lpips()
    assert loaded is not None
    assert loaded.digest == module.WEIGHTS_SHA256


def test_without_weights_there_is_a_reason_and_no_guess(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_lpips_package_file", lambda: None)
    loaded, reason = load_lpips()
    assert loaded is None
    assert "--lpips-weights" in reason


def test_a_file_that_was_named_must_be_there(tmp_path: Path) -> None:
    with pytest.raises(SplashbenchError, match=r"weights.npz does not exist"):
        load_lpips(tmp_path / "weights.npz")


def made_up() -> dict[str, np.ndarray]:
    """Arrays of the right shapes, which are no weights."""
    shapes = {1: (64, 3, 11, 11), 2: (192, 64, 5, 5), 3: (384, 192, 3, 3), 4: (256, 384, 3, 3), 5: (256, 256, 3, 3)}
    arrays = {f"conv{i}.weight": np.zeros(shape, np.float32) for i, shape in shapes.items()}
    arrays |= {f"conv{i}.bias": np.zeros(shape[0], np.float32) for i, shape in shapes.items()}
    arrays |= {f"lin{i - 1}": np.zeros(shape[0], np.float32) for i, shape in shapes.items()}
    return arrays


def test_weights_in_the_cache_are_hashed_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from splashbench.score.image import weights

    monkeypatch.delenv(module.WEIGHTS_VARIABLE, raising=False)
    monkeypatch.setenv("SPLASHBENCH_CACHE", str(tmp_path))
    np.savez(weights.weights_path(), **made_up())  # type: ignore[arg-type]
    hashed: list[object] = []
    for place in (module, weights):
        monkeypatch.setattr(place, "weights_digest", lambda given: hashed.append(given) or module.WEIGHTS_SHA256)
    assert load_lpips()[0] is not None
    assert len(hashed) == 1


def test_other_weights_are_refused(tmp_path: Path) -> None:
    np.savez(tmp_path / "made_up.npz", **made_up())  # type: ignore[arg-type]
    with pytest.raises(SplashbenchError, match="not those of AlexNet"):
        load_lpips(tmp_path / "made_up.npz")


@pytest.fixture
def unlike_real_ones() -> Lpips:
    """The network with weights at random, biases among them: what it sees of black is not nothing."""
    rng = np.random.default_rng(0)
    arrays = {name: rng.normal(0, 0.05, array.shape).astype(np.float32) for name, array in made_up().items()}
    arrays |= {f"lin{i}": np.abs(arrays[f"lin{i}"]) for i in range(5)}
    return Lpips(arrays, module.weights_digest(arrays))


def whole_images(metric: Lpips, first: np.ndarray, second: np.ndarray) -> float:
    """The distance by the definition: features of the whole images, all of them."""
    import torch

    images = torch.from_numpy(np.stack([first, second]).astype(np.float32)).permute(0, 3, 1, 2)
    total = 0.0
    for features, head in zip(metric._features(2 * images - 1), metric._heads):
        unit = features / (features.square().sum(1, keepdim=True).sqrt() + 1e-10)
        total += float(((unit[:1] - unit[1:]).square() * head).sum(1).double().mean())
    return total


@pytest.mark.parametrize("size", [(31, 31), (33, 470), (401, 212), (437, 523)])
@pytest.mark.parametrize("place", ["corner", "middle", "end", "line", "everywhere"])
def test_what_is_equal_is_not_looked_at_and_counts(unlike_real_ones: Lpips, size: tuple[int, int], place: str) -> None:
    height, width = size
    boxes = {
        "corner": np.s_[:3, :5],
        "middle": np.s_[height // 2 : height // 2 + 9, width // 3 : width // 3 + 1],
        "end": np.s_[-1:, -2:],
        "line": np.s_[height // 2, :],
        "everywhere": np.s_[:, :],
    }
    rng = np.random.default_rng(1)
    first = rng.random((height, width, 3))
    second = first.copy()
    second[boxes[place]] = rng.random(second[boxes[place]].shape)
    expected = whole_images(unlike_real_ones, first, second)
    assert unlike_real_ones(first, second) == pytest.approx(expected, rel=1e-4, abs=1e-12)
