"""No method sees a test image: runs are the same, byte for byte, where test views and truth cannot be read."""

import shutil
from pathlib import Path

import pytest

from splashbench import toml
from splashbench.harness.runner import run_method
from splashbench.scene import Scene
from splashbench.submission import Status, Submission

SETTINGS = toml.load(Path(__file__).with_name("small_fits.toml"))
PEEKING = Path(__file__).parents[1] / "harness" / "conformance" / "methods_for_conformance.py"
# The lite variant is read as the full one is, scaffold_gs as `nothing` is, which splashsplat fits as well; the others'
# photographs are read by what reads spacetime_gaussians'.
_SLOW = ("spacetime_gaussians_lite", "scaffold_gs", "nothing", "deformable_3dgs", "scaffold_4d")


@pytest.fixture(scope="module")
def unreadable(balls_directory: Path, balls: Scene, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The scene with garbage in place of test images, test masks and the truth."""
    directory = Path(shutil.copytree(balls_directory, tmp_path_factory.mktemp("unreadable") / "balls"))
    for path in sorted(directory.rglob("*")):
        parts = path.relative_to(directory).parts
        if path.is_file() and (parts[0] == "truth" or (parts[0] in ("ims", "seg") and parts[1] in balls.test)):
            path.write_bytes(b"garbage")
    return directory


def _handed_in(name: str, scene: Path, out: Path) -> tuple[Submission, dict[str, bytes]]:
    """The submission, and what the method made of the scene: renders, opacity, particles, geometry and model."""
    submission = run_method(name, scene, out, preset=_quick(name), overrides=SETTINGS.get(name), timing_frames=0)
    ours = ("submission.toml", "record.json", "SHA256SUMS")
    files = sorted(path for path in out.rglob("*") if path.is_file())
    return submission, {path.relative_to(out).as_posix(): path.read_bytes() for path in files if path.name not in ours}


def _quick(name: str) -> str | None:
    return None if name == "nearest_camera" else "quick"


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] if name in _SLOW else []) for name in SETTINGS]
)
def test_a_run_is_the_same_without_test_views(
    name: str, balls_directory: Path, unreadable: Path, balls: Scene, tmp_path: Path
) -> None:
    ordinary, expected = _handed_in(name, balls_directory, tmp_path / "ordinary")
    blind, found = _handed_in(name, unreadable, tmp_path / "blind")
    assert (ordinary.status, blind.status) == (Status.OK, Status.OK), blind.reason
    assert {f"renders/{camera}/{t:06d}.png" for camera in balls.test for t in range(balls.n_frames)} <= set(expected)
    assert sorted(found) == sorted(expected)
    assert [path for path in expected if found[path] != expected[path]] == []


def test_a_method_that_does_look_is_another_run(balls_directory: Path, unreadable: Path, tmp_path: Path) -> None:
    _, expected = _handed_in(f"{PEEKING}:Peeks", balls_directory, tmp_path / "ordinary")
    _, found = _handed_in(f"{PEEKING}:Peeks", unreadable, tmp_path / "blind")
    assert found["renders/6/000000.png"] != expected["renders/6/000000.png"]
