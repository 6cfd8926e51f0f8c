"""What pip sees of the build: requirements, wheels, source archives, editable installations."""

from __future__ import annotations

import importlib.metadata
import importlib.util
import itertools
import os
import shutil
import subprocess
import sys
import tarfile
import venv
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest

import build_kernel
from build_compilers import VARIANTS, ZIG, ZIGLANG, Compiler, choose_compiler

ROOT = Path(__file__).parents[2]
GCC = Compiler(("g++",))
Outcome = subprocess.CompletedProcess[str]


@pytest.fixture(scope="module")
def checkout(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of what the build reads, without anything that was built."""
    setuptools = pytest.importorskip("setuptools", reason="the hooks need setuptools")
    if int(setuptools.__version__.split(".")[0]) < 77:
        pytest.skip(f"the hooks need setuptools 77, this is {setuptools.__version__}")
    copy = tmp_path_factory.mktemp("checkout")
    for name in (
        "pyproject.toml",
        "setup.py",
        "build_kernel.py",
        "build_compilers.py",
        "MANIFEST.in",
        "README.md",
        "LICENSE",
    ):
        shutil.copy2(ROOT / name, copy / name)
    for name in ("splashbench", "methods", "data_manifest", "leaderboards"):
        shutil.copytree(ROOT / name, copy / name, ignore=shutil.ignore_patterns("__pycache__", "lib*.so"))
    return copy


def clean_environment() -> dict[str, str]:
    """That of this process, without a choice of compiler."""
    return {name: value for name, value in os.environ.items() if name not in ("CXX", "SPLASHBENCH_CXX", "PYTHONPATH")}


def hook(checkout: Path, call: str, path: Path, python_path: Path | None = None, choice: str = "") -> Outcome:
    """Call a hook as pip does, in a process of its own, with `path` for PATH and `choice` for SPLASHBENCH_CXX."""
    environ = {**clean_environment(), "PATH": str(path), "SPLASHBENCH_CXX": choice}
    if python_path is not None:
        environ["PYTHONPATH"] = str(python_path)
    code = f"import build_kernel; print(build_kernel.{call})"
    return subprocess.run(
        [sys.executable, "-W", "ignore", "-c", code], cwd=checkout, env=environ, capture_output=True, text=True
    )


@pytest.fixture(scope="module")
def compilers(tmp_path_factory: pytest.TempPathFactory, stand_in: Callable[..., Path]) -> Path:
    """A folder with a stand-in for a compiler, to be the whole PATH."""
    return stand_in(tmp_path_factory.mktemp("bin") / "c++").parent


@pytest.fixture(scope="module")
def zig(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a stand-in for the ziglang package."""
    folder = tmp_path_factory.mktemp("packages")
    (folder / "ziglang").mkdir()
    (folder / "ziglang" / "__main__.py").write_text(
        "import pathlib, sys\npathlib.Path(sys.argv[sys.argv.index('-o') + 1]).write_text('made by zig')\n"
    )
    (folder / "ziglang-0.0.dist-info").mkdir()
    (folder / "ziglang-0.0.dist-info" / "METADATA").write_text("Metadata-Version: 2.1\nName: ziglang\nVersion: 0.0\n")
    return folder


@pytest.mark.parametrize("name", ["get_requires_for_build_wheel", "get_requires_for_build_editable"])
def test_a_compiler_is_required_only_where_there_is_none(
    name: str, checkout: Path, compilers: Path, tmp_path: Path
) -> None:
    def required(path: Path, choice: str = "") -> str:
        outcome = hook(checkout, f"{name}()", path, choice=choice)
        assert outcome.returncode == 0, outcome.stderr
        return outcome.stdout.splitlines()[-1]

    assert required(compilers) == "[]"
    assert required(tmp_path) == f"['{ZIGLANG}']"
    assert required(compilers, choice="zig") == f"['{ZIGLANG}']"


def test_a_source_archive_needs_no_compiler(checkout: Path, tmp_path: Path) -> None:
    outcome = hook(checkout, "get_requires_for_build_sdist()", tmp_path)
    assert outcome.returncode == 0, outcome.stderr
    assert outcome.stdout.splitlines()[-1] == "[]"


IN_TREE = {
    f"{folder}/kernel/lib{name}_{variant}.so"
    for folder, name in (
        ("splashbench/gaussians", "gaussians"),
        ("splashbench/observe", "observe"),
        ("splashbench/render", "render"),
        ("methods/scaffold_gs", "scaffold_gs"),
        ("methods/splashsplat", "splashsplat"),
    )
    for variant in ("baseline", "avx2", "avx512")
}
LIBRARIES = {path.replace("methods/", "splashbench_methods/") for path in IN_TREE}  # as they are installed


def built_wheel(outcome: Outcome, folder: Path) -> tuple[str, set[str], str]:
    """The one wheel in `folder`: the platform in its name, its files and what its WHEEL file says."""
    assert outcome.returncode == 0, outcome.stderr
    (path,) = folder.glob("*.whl")
    with zipfile.ZipFile(path) as archive:
        names = set(archive.namelist())
        (about,) = [name for name in names if name.endswith(".dist-info/WHEEL")]
        python, abi, platform = path.stem.split("-")[-3:]
        assert (python, abi) == ("py3", "none")
        return platform, names, archive.read(about).decode()


def test_the_wheel_of_the_systems_compiler(checkout: Path, compilers: Path, tmp_path: Path) -> None:
    platform, names, about = built_wheel(hook(checkout, f"build_wheel({str(tmp_path)!r})", compilers), tmp_path)
    assert platform == GCC.wheel_platform
    assert f"Tag: py3-none-{platform}" in about.splitlines()
    assert "Root-Is-Purelib: false" in about.splitlines()
    assert {name for name in names if name.endswith(".so")} == LIBRARIES
    assert [name for name in names if name.endswith((".o", ".new")) or name.startswith("build")] == []


def test_the_wheel_of_zig(checkout: Path, zig: Path, tmp_path: Path) -> None:
    (empty := tmp_path / "empty").mkdir()
    outcome = hook(checkout, f"build_wheel({str(tmp_path)!r})", empty, zig)
    platform, names, _ = built_wheel(outcome, tmp_path)
    assert platform == ZIG.wheel_platform
    assert names >= LIBRARIES


def test_a_wheel_from_the_source_archive(checkout: Path, compilers: Path, tmp_path: Path) -> None:
    outcome = hook(checkout, f"build_sdist({str(tmp_path)!r})", compilers)
    assert outcome.returncode == 0, outcome.stderr
    (path,) = tmp_path.glob("*.tar.gz")
    with tarfile.open(path) as archive:
        assert [name for name in archive.getnames() if name.endswith(".so") or "/build/" in name] == []
        # Stand-ins for compilers read nothing, so a header that is missing shows here alone.
        shipped = {name.partition("/")[2] for name in archive.getnames() if name.endswith((".cpp", ".h"))}
        assert shipped == {
            path.relative_to(checkout).as_posix()
            for folder in ("splashbench", "methods")
            for path in (checkout / folder).rglob("*")
            if path.suffix in (".cpp", ".h")
        }
        if hasattr(tarfile, "data_filter"):
            archive.extractall(tmp_path, filter="data")
        else:
            archive.extractall(tmp_path)
    (unpacked,) = (folder for folder in tmp_path.iterdir() if folder.is_dir())
    _, names, _ = built_wheel(hook(unpacked, f"build_wheel({str(tmp_path)!r})", compilers), tmp_path)
    assert names >= LIBRARIES


def test_an_editable_installation_has_the_libraries_in_place(checkout: Path, compilers: Path, tmp_path: Path) -> None:
    outcome = hook(checkout, f"build_editable({str(tmp_path)!r})", compilers)
    built_wheel(outcome, tmp_path)
    places = {path.relative_to(checkout).as_posix() for path in checkout.rglob("lib*.so") if "build" not in path.parts}
    assert places == IN_TREE


def test_without_a_compiler_the_build_ends_in_one_clear_line(checkout: Path, tmp_path: Path) -> None:
    if importlib.util.find_spec("ziglang") is not None:
        pytest.skip("ziglang is installed here")
    outcome = hook(checkout, f"build_wheel({str(tmp_path)!r})", tmp_path)
    assert outcome.returncode != 0
    assert outcome.stderr.splitlines()[-1].startswith("error: no C++17 compiler with vector extensions was found")
    assert "Traceback" not in outcome.stderr
    assert list(tmp_path.iterdir()) == []


def test_a_broken_compiler_stops_the_question_for_requirements_in_one_line(checkout: Path, tmp_path: Path) -> None:
    outcome = hook(checkout, "get_requires_for_build_wheel()", tmp_path, choice="no-such-compiler")
    assert outcome.returncode != 0
    assert outcome.stderr.splitlines()[-1].startswith("error: SPLASHBENCH_CXX=no-such-compiler cannot")
    assert "Traceback" not in outcome.stderr


@pytest.mark.skipif(shutil.which("make") is None, reason="needs make")
def test_make_installs_anew_when_a_kernel_changed(tmp_path: Path) -> None:
    (tmp_path / ".venv").mkdir()
    shutil.copy2(ROOT / "Makefile", tmp_path)
    seconds = itertools.count(1_000_000_000)

    def touch(path: Path) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
        now = next(seconds)
        os.utime(path, (now, now))

    build_files = ["setup.py", "build_kernel.py", "build_compilers.py"]
    sources = [
        folder / name
        for folder in (build_kernel.NATIVE, *(kernel.folder for kernel in build_kernel.kernels()))
        for name in ("a.cpp", "a.h")
    ]
    installed = tmp_path / ".venv" / "installed-test"
    for name in ("pyproject.toml", "constraints.txt", ".venv/ready", *build_files, *sources):
        touch(tmp_path / name)
    touch(installed)

    def up_to_date() -> bool:
        return subprocess.run(["make", "-q", ".venv/installed-test"], cwd=tmp_path).returncode == 0

    assert up_to_date()
    for name in (*build_files, *sources):
        touch(tmp_path / name)
        assert not up_to_date(), name
        touch(installed)
        assert up_to_date()


@pytest.mark.slow
def test_installs_and_runs_where_there_is_no_compiler(checkout: Path, tmp_path: Path) -> None:
    """pip, with a PATH that has a few tools and no compiler: it fetches zig, which builds a kernel that runs."""
    tools = tmp_path / "tools"
    tools.mkdir()
    for name in ("sh", "uname", "cat", "ls", "rm", "mkdir"):
        tool = shutil.which(name)
        assert tool is not None
        (tools / name).symlink_to(tool)
    venv.create(tmp_path / "venv", with_pip=True)
    python = tmp_path / "venv" / "bin" / "python"
    question = "import sysconfig; print(sysconfig.get_path('platlib'))"
    site = subprocess.run([python, "-c", question], check=True, capture_output=True, text=True).stdout.strip()
    # The dependencies are those of this environment; the package itself and its compiler are the new one's.
    here = importlib.metadata.distribution("numpy").locate_file("")
    Path(site, "dependencies.pth").write_text(f"{here}\n", encoding="utf-8")
    environ = clean_environment()
    environ["PATH"] = os.pathsep.join([str(python.parent), str(tools)])
    assert choose_compiler(environ) is ZIG
    pip = [str(python), "-m", "pip", "install", "--disable-pip-version-check", "--no-deps", "--force-reinstall"]
    outcome = subprocess.run([*pip, str(checkout)], env=environ, cwd=tmp_path, capture_output=True, text=True)
    if outcome.returncode != 0 and "ziglang" in outcome.stderr and "No matching distribution" in outcome.stderr:
        pytest.skip("pip cannot fetch ziglang here")
    assert outcome.returncode == 0, outcome.stdout + outcome.stderr
    code = (
        "import importlib.metadata as m, splashbench.render.native as r;"
        "import splashbench_methods.splashsplat.kernel.library as s;"
        "print(m.distribution('splashbench').read_text('WHEEL')); print(r.__file__);"
        "print(r.KERNEL.variant, s.KERNEL.variant)"
    )
    outcome = subprocess.run([python, "-c", code], env=environ, cwd=tmp_path, capture_output=True, text=True)
    assert outcome.returncode == 0, outcome.stderr
    *about, file, variants = outcome.stdout.splitlines()
    assert f"Tag: py3-none-{ZIG.wheel_platform}" in about
    assert file.startswith(str(tmp_path))
    assert set(variants.split()) <= {variant.name for variant in VARIANTS}
