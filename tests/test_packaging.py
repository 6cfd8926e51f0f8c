"""What a user installs: the wheel holds every file the code reads, starts light, and names nobody's machine."""

from __future__ import annotations

import ast
import configparser
import os
import re
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path
from typing import Any

import pytest

from splashbench import toml

ROOT = Path(__file__).parents[1]
PACKAGES = {
    "splashbench": "splashbench",
    "methods": "splashbench_methods",
    "data_manifest": "splashbench_data_manifest",
    "leaderboards": "splashbench_leaderboards",
}


def checkout_files() -> list[Path]:
    """Files of the checkout that git tracks or would, relative to its root."""
    if not (ROOT / ".git").exists() or shutil.which("git") is None:
        pytest.skip("needs git and a checkout")
    listed = subprocess.run(
        ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"],
        cwd=ROOT,
        check=True,
        capture_output=True,
        text=True,
    )
    return sorted({Path(name) for name in listed.stdout.split("\0") if name and (ROOT / name).is_file()})


@pytest.fixture(scope="module")
def project() -> dict[str, Any]:
    return toml.load(ROOT / "pyproject.toml")


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A wheel built from a copy of the checkout by the backend itself, so without pip and without a network."""
    setuptools = pytest.importorskip("setuptools", reason="building the wheel needs setuptools")
    if int(setuptools.__version__.split(".")[0]) < 77:
        pytest.skip(f"building the wheel needs setuptools 77, this is {setuptools.__version__}")
    copy = tmp_path_factory.mktemp("checkout")
    for path in checkout_files():
        (copy / path).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(ROOT / path, copy / path)
    compiled = ROOT / "build" / "kernel"  # taken over where its digests still fit
    if compiled.is_dir():
        shutil.copytree(compiled, copy / "build" / "kernel", ignore=shutil.ignore_patterns("zig", "new-*"))
    built = tmp_path_factory.mktemp("wheel")
    code = "import sys; from setuptools import build_meta; build_meta.build_wheel(sys.argv[1])"
    done = subprocess.run([sys.executable, "-c", code, str(built)], cwd=copy, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    (path,) = built.glob("*.whl")
    return path


def test_the_wheel_holds_every_module_and_data_file(wheel: Path) -> None:
    """Each file of a package folder is in the wheel, but for notes to readers, and the page of the project's runs."""
    shipped = set(zipfile.ZipFile(wheel).namelist())
    wanted = {
        "/".join((PACKAGES[path.parts[0]], *path.parts[1:]))
        for path in checkout_files()
        if path.parts[0] in PACKAGES
        and path.suffix != ".md"
        and not path.as_posix().startswith("leaderboards/told_nothing")
    }
    assert {f"{package}/__init__.py" for package in PACKAGES.values()} <= wanted
    assert sorted(wanted - shipped) == []


def test_the_wheel_holds_nothing_else_on_the_top_level(wheel: Path) -> None:
    tops = {name.split("/")[0] for name in zipfile.ZipFile(wheel).namelist()}
    assert {top for top in tops if not top.endswith(".dist-info")} == set(PACKAGES.values())


def test_the_wheel_carries_the_licence(wheel: Path) -> None:
    archive = zipfile.ZipFile(wheel)
    (name,) = [name for name in archive.namelist() if name.endswith("/LICENSE")]
    assert "Apache License" in archive.read(name).decode()


def test_every_entry_point_leads_to_a_module_in_the_wheel(wheel: Path, project: dict[str, Any]) -> None:
    archive = zipfile.ZipFile(wheel)
    names = set(archive.namelist())
    (entry_file,) = [name for name in names if name.endswith("entry_points.txt")]
    parser = configparser.ConfigParser()
    parser.read_string(archive.read(entry_file).decode())
    declared = {"console_scripts": project["project"]["scripts"], **project["project"]["entry-points"]}
    assert {section: dict(parser[section]) for section in parser.sections()} == declared
    targets = [target.split(":")[0].replace(".", "/") for group in declared.values() for target in group.values()]
    assert [t for t in targets if f"{t}.py" not in names and f"{t}/__init__.py" not in names] == []


def test_data_is_found_from_an_installed_wheel(wheel: Path, tmp_path: Path) -> None:
    zipfile.ZipFile(wheel).extractall(tmp_path)
    code = (
        "import splashbench.manifest as m, splashbench.paper_figures as l;"
        "print(m.__file__); print(len(m.load_scenes()), m.load_archive().name, len(m.load_comparison()) > 1);"
        "print(len(l.paper_rows()) > 1)"
    )
    lines = run_python(code, cwd=tmp_path, PYTHONPATH=str(tmp_path)).splitlines()
    assert lines[0].startswith(str(tmp_path))
    assert lines[1:] == ["20 real_scene.zip True", "True"]


def test_compiled_kernels_are_loaded_from_an_installed_wheel(wheel: Path, tmp_path: Path) -> None:
    zipfile.ZipFile(wheel).extractall(tmp_path)
    code = (
        "from splashbench.observe.carving import KERNEL as observe;"
        "from splashbench.render.native import KERNEL as renderer;"
        "from splashbench_methods.splashsplat.kernel.library import KERNEL as splashsplat;"
        "[print(kernel.library._name, kernel.variant) for kernel in (observe, renderer, splashsplat)]"
    )
    environment = {"PYTHONPATH": str(tmp_path), "SPLASHBENCH_SIMD": "baseline", "SPLASHBENCH_KERNEL": ""}
    assert run_python(code, cwd=tmp_path, **environment).splitlines() == [
        f"{tmp_path}/splashbench/observe/kernel/libobserve_baseline.so baseline",
        f"{tmp_path}/splashbench/render/kernel/librender_baseline.so baseline",
        f"{tmp_path}/splashbench_methods/splashsplat/kernel/libsplashsplat_baseline.so baseline",
    ]


def run_python(code: str, cwd: Path, **environment: str) -> str:
    """Standard output of a fresh interpreter."""
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=cwd, env={**os.environ, **environment}, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.parametrize(
    ("module", "heavy"),
    [
        ("splashbench.cli.main", ["torch", "numba", "cv2", "matplotlib", "pycolmap", "av", "scipy", "pandas"]),
        ("splashbench.scene", ["torch", "numba", "cv2", "matplotlib", "pycolmap", "av"]),
        ("splashbench.manifest", ["torch", "numba", "cv2", "matplotlib", "pycolmap", "av"]),
    ],
)
def test_importing_stays_light(module: str, heavy: list[str], tmp_path: Path) -> None:
    code = f"import sys, {module}; print(' '.join(name for name in {heavy!r} if name in sys.modules))"
    assert run_python(code, cwd=tmp_path).split() == []


def test_every_module_says_what_it_is_for() -> None:
    silent = []
    for path in checkout_files():
        if path.suffix != ".py" or (path.parts[0] not in PACKAGES and path.parts[0] not in {"tests", "benchmarks"}):
            continue
        docstring = ast.get_docstring(ast.parse((ROOT / path).read_text(encoding="utf-8"))) or ""
        first_line = docstring.partition("\n")[0]
        if len(first_line.split()) < 3:
            silent.append(str(path))
    assert silent == []


# Spelt in pieces, so that this file does not name what it looks for.
FORBIDDEN = re.compile(
    r"(?<![\w.~-])/(?:work|root)/|(?<![\w.~-])/home/\w|"
    + "|".join(["pypi" + r"\.org", "python" + "hosted", "npm" + r"js\."])
)


def test_no_file_names_a_machine_path_or_a_package_registry() -> None:
    found = []
    for path in checkout_files():
        try:
            text = (ROOT / path).read_text(encoding="utf-8")
        except UnicodeDecodeError:
            continue
        found += [f"{path}:{n}" for n, line in enumerate(text.splitlines(), 1) if FORBIDDEN.search(line)]
    assert found == []


@pytest.mark.parametrize("parts", [["see ", "root", "x"], ["'", "work", "main'"], ["", "home", "anna"]])
def test_the_search_for_machine_paths_finds_them(parts: list[str]) -> None:
    assert FORBIDDEN.search("/".join(parts))
    assert not FORBIDDEN.search("the frame/work/flow of https://example.org/work/ and ../work/")


def constraint_lines() -> list[str]:
    text = (ROOT / "constraints.txt").read_text(encoding="utf-8")
    return [line for line in text.splitlines() if line and not line.startswith("#")]


@pytest.mark.parametrize("python", ["3.10", "3.11", "3.12", "3.13"])
def test_every_direct_dependency_has_one_pin_that_it_accepts(python: str, project: dict[str, Any]) -> None:
    requirements = pytest.importorskip("packaging.requirements", reason="comes with pytest")
    environment = {"python_version": python}
    pins: dict[str, str] = {}
    for line in constraint_lines():
        pin = requirements.Requirement(line)
        if pin.marker is None or pin.marker.evaluate(environment):
            (specifier,) = pin.specifier
            assert specifier.operator == "=="
            assert pin.name.lower() not in pins, f"{pin.name} is pinned twice for Python {python}"
            pins[pin.name.lower()] = specifier.version
    groups = [project["project"]["dependencies"], *project["project"]["optional-dependencies"].values()]
    for text in (text for group in groups for text in group):
        wanted = requirements.Requirement(text)
        if wanted.name == "splashbench" or (wanted.marker and not wanted.marker.evaluate(environment)):
            continue
        assert wanted.specifier.contains(pins[wanted.name.lower()]), f"Python {python}: {text}"
