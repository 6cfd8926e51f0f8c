"""Building the renderer's kernel: which compiler is taken, what pip is told, the wheel's name, what is rebuilt."""

from __future__ import annotations

import ctypes
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
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

Done = subprocess.CompletedProcess[str]

ROOT = Path(__file__).parents[1]
NATIVE_SYSTEM = {"linux": "linux", "darwin": "macosx"}.get(sys.platform, "win")

pytestmark = pytest.mark.skipif(NATIVE_SYSTEM == "win", reason="the stand-ins for compilers are shell scripts")


def _load() -> ModuleType:
    """build_kernel.py, which is beside the package and not in it."""
    spec = importlib.util.spec_from_file_location("build_kernel", ROOT / "build_kernel.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


build_kernel = _load()
KernelBuildError = build_kernel.KernelBuildError
TARGET = build_kernel.this_target()
GCC = build_kernel.Compiler(("g++",))
ZIG = build_kernel.ZIG

# A stand-in for a compiler: notes its arguments, writes the file that -o names, fails where told to.
STAND_IN = """#!/bin/sh
if [ "$1" = --version ]; then echo "stand-in {version}"; exit 0; fi
echo "$*" >> "$0.log"
failed=0
for word in "$@"; do case "$word" in {refused}) failed=1;; esac; done
while [ $# -gt 0 ]; do if [ "$1" = -o ]; then echo made > "$2"; fi; shift; done
if [ $failed = 1 ]; then echo "stand-in: cannot" >&2; fi
exit $failed
"""


def stand_in(path: Path, refused: str = "nothing", version: str = "1") -> Path:
    """A compiler at `path` that fails where an argument matches the shell pattern `refused`."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(STAND_IN.format(refused=refused, version=version), encoding="utf-8")
    path.chmod(0o755)
    return path


def calls(compiler: Path) -> list[str]:
    """The arguments of each call since the last time."""
    log = compiler.with_name(compiler.name + ".log")
    lines = log.read_text(encoding="utf-8").splitlines() if log.exists() else []
    log.unlink(missing_ok=True)
    return lines


# --- The choice of a compiler ----------------------------------------------------------------------------------------


def choose(environ: dict[str, str]) -> Any:
    return build_kernel.choose_compiler(TARGET, environ)


def test_the_environment_goes_before_the_path(tmp_path: Path) -> None:
    mine, usual = stand_in(tmp_path / "mine"), stand_in(tmp_path / "usual")
    on_path = stand_in(tmp_path / "bin" / "c++")
    environ = {"SPLASHBENCH_CXX": str(mine), "CXX": str(usual), "PATH": str(on_path.parent)}
    assert choose(environ).command == (str(mine),)
    del environ["SPLASHBENCH_CXX"]
    assert choose(environ).command == (str(usual),)
    del environ["CXX"]
    assert choose(environ).command == (str(on_path),)


def test_zig_can_be_asked_for_beside_a_working_compiler(tmp_path: Path) -> None:
    on_path = stand_in(tmp_path / "c++")
    assert choose({"SPLASHBENCH_CXX": "zig", "PATH": str(tmp_path)}) is ZIG
    assert calls(on_path) == []


def test_a_named_compiler_may_have_arguments(tmp_path: Path) -> None:
    compiler = stand_in(tmp_path / "compiler")
    assert choose({"CXX": f"{compiler} --sysroot='a b'"}).command == (str(compiler), "--sysroot=a b")
    assert "--sysroot=a b -" in calls(compiler)[0]


def test_compilers_on_the_path_that_cannot_build_are_passed_over(tmp_path: Path) -> None:
    stand_in(tmp_path / "c++", refused="-o")
    last = stand_in(tmp_path / "clang++")
    assert choose({"PATH": str(tmp_path)}).command == (str(last),)


def test_the_probe_asks_for_the_most_demanding_variant(tmp_path: Path) -> None:
    hardest = TARGET.variants[-1]
    stand_in(tmp_path / "c++", refused=f"-DSPLASH_LANES={hardest.lanes}")
    assert choose({"PATH": str(tmp_path)}) is ZIG


@pytest.mark.skipif(NATIVE_SYSTEM != "linux", reason="a matter of Linux distributions")
def test_a_compiler_without_a_static_library_links_the_shared_one(tmp_path: Path) -> None:
    stand_in(tmp_path / "c++", refused="-static-libstdc++")
    compiler = choose({"PATH": str(tmp_path)})
    assert compiler.command == (str(tmp_path / "c++"),)
    assert [flag for flag in compiler.link_flags(TARGET) if "static" in flag] == []
    assert "-static-libstdc++" in GCC.link_flags(TARGET)


def test_without_a_compiler_it_is_zig(tmp_path: Path) -> None:
    assert choose({"PATH": str(tmp_path)}) is ZIG


@pytest.mark.parametrize("name", ["SPLASHBENCH_CXX", "CXX"])
@pytest.mark.parametrize("fault", ["missing", "broken"])
def test_a_named_compiler_that_cannot_build_is_an_error(tmp_path: Path, name: str, fault: str) -> None:
    stand_in(tmp_path / "broken", refused="-o")
    stand_in(tmp_path / "c++")
    with pytest.raises(KernelBuildError, match=rf"^{name}=.*{fault} cannot .*SPLASHBENCH_CXX=zig") as caught:
        choose({name: str(tmp_path / fault), "PATH": str(tmp_path)})
    assert "\n" not in str(caught.value)


def test_no_compiler_and_no_zig_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def version(name: str) -> str:
        raise importlib.metadata.PackageNotFoundError(name)

    monkeypatch.setattr(importlib.metadata, "version", version)
    with pytest.raises(KernelBuildError, match=r"^no C\+\+17 compiler .*g\+\+.*pip install ziglang==[\d.]+$"):
        build_kernel.installed_compiler(TARGET, {"PATH": str(tmp_path)})


def test_the_constraints_pin_the_same_zig() -> None:
    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    assert [line for line in lines if line.startswith("ziglang")] == [build_kernel.ZIGLANG]


# --- The table -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "machine", "system_tag", "zig_tag", "zig_target", "suffix"),
    [
        ("linux-x86_64", "", "linux_x86_64", "manylinux_2_17_x86_64", "x86_64-linux-gnu.2.17", ".so"),
        ("linux-aarch64", "", "linux_aarch64", "manylinux_2_17_aarch64", "aarch64-linux-gnu.2.17", ".so"),
        ("macosx-10.13-x86_64", "", "macosx_11_0_x86_64", "macosx_11_0_x86_64", "x86_64-macos.11.0", ".dylib"),
        ("macosx-14.0-arm64", "", "macosx_11_0_arm64", "macosx_11_0_arm64", "aarch64-macos.11.0", ".dylib"),
        ("macosx-11.0-universal2", "arm64", "macosx_11_0_arm64", "macosx_11_0_arm64", "aarch64-macos.11.0", ".dylib"),
        ("win-amd64", "", "win_amd64", "win_amd64", "x86_64-windows-gnu", ".dll"),
        ("win-arm64", "", "win_arm64", "win_arm64", "aarch64-windows-gnu", ".dll"),
    ],
)
def test_platforms(name: str, machine: str, system_tag: str, zig_tag: str, zig_target: str, suffix: str) -> None:
    target = build_kernel.target_of(name, machine)
    assert build_kernel.wheel_platform(target, GCC) == system_tag
    assert build_kernel.wheel_platform(target, ZIG) == zig_tag
    assert ("-target", zig_target) == ZIG.link_flags(target)[:2]
    for variant in target.variants:
        assert target.library(variant) == f"libsplash_{variant.name}{suffix}"
        assert ("-target", zig_target) == ZIG.compile_flags(target, variant)[:2]


@pytest.mark.parametrize("name", ["linux-riscv64", "linux-armv7l", "freebsd-14.0-amd64", "win32", "mingw"])
def test_an_unknown_platform_is_an_error_that_names_it(name: str) -> None:
    with pytest.raises(KernelBuildError, match=rf"^{name}: .*Linux, macOS and Windows"):
        build_kernel.target_of(name, name)


def test_variants_of_both_processors() -> None:
    x86, arm = (build_kernel.target_of(name, "").variants for name in ("linux-x86_64", "linux-aarch64"))
    assert [(v.name, v.lanes) for v in x86] == [("baseline", 4), ("avx2", 8), ("avx512", 16)]
    assert [(v.name, v.lanes) for v in arm] == [("neon", 4)]
    assert [v.instructions[0] for v in x86] == ["-march=x86-64", "-march=x86-64-v3", "-march=x86-64-v4"]
    assert [v.zig_cpu[0] for v in x86] == ["-mcpu=x86_64", "-mcpu=x86_64_v3", "-mcpu=x86_64_v4"]


@pytest.mark.parametrize("name", ["linux-x86_64", "linux-aarch64", "macosx-14.0-arm64", "win-amd64"])
@pytest.mark.parametrize("compiler", [GCC, ZIG])
def test_flags(name: str, compiler: Any) -> None:
    target = build_kernel.target_of(name, "")
    for variant in target.variants:
        flags = compiler.compile_flags(target, variant)
        assert {"-O3", "-std=c++17", f"-DSPLASH_LANES={variant.lanes}"} <= set(flags)
        assert not {"-ffast-math", "-Ofast", "-ffinite-math-only", "-fassociative-math"} & set(flags)
        assert ("-fPIC" in flags) == (target.system != "win")  # clang refuses it there
        sanitized = [*compiler.compile_flags(target, variant, sanitize=True), *compiler.link_flags(target, True)]
        assert sanitized.count("-fsanitize=address,undefined") == 2
        assert "-s" not in sanitized


# --- What is rebuilt -------------------------------------------------------------------------------------------------


@pytest.fixture
def kernel(tmp_path: Path) -> Path:
    """A source tree with a kernel of two files and a header."""
    folder = tmp_path / "tree" / build_kernel.KERNEL
    folder.mkdir(parents=True)
    for name in ("one.cpp", "two.cpp", "shared.h"):
        (folder / name).write_text(f"// {name}\n", encoding="utf-8")
    return folder


VARIANTS = len(TARGET.variants)
EVERYTHING = (2 * VARIANTS, VARIANTS)


def compiled_and_linked(kernel: Path, compiler: Path, **options: object) -> tuple[int, int]:
    """Build, and count the calls of the compiler."""
    root = kernel.parents[2]
    libraries = build_kernel.build(TARGET, build_kernel.Compiler((str(compiler),)), root / "out", root=root, **options)
    assert [library.read_text() for library in libraries] == ["made\n"] * VARIANTS
    lines = calls(compiler)
    return sum(" -c " in line for line in lines), sum(" -c " not in line for line in lines)


def test_only_what_changed_is_rebuilt(kernel: Path, tmp_path: Path) -> None:
    compiler = stand_in(tmp_path / "compiler")
    assert compiled_and_linked(kernel, compiler) == EVERYTHING
    assert compiled_and_linked(kernel, compiler) == (0, 0)
    os.utime(kernel / "one.cpp")
    assert compiled_and_linked(kernel, compiler) == (0, 0)
    (kernel / "one.cpp").write_text("// another one\n")
    assert compiled_and_linked(kernel, compiler) == (VARIANTS, VARIANTS)
    (kernel / "shared.h").write_text("// another header\n")
    assert compiled_and_linked(kernel, compiler) == EVERYTHING
    (kernel / "more.h").write_text("// a new header\n")
    assert compiled_and_linked(kernel, compiler) == EVERYTHING
    (kernel / "two.cpp").unlink()
    assert compiled_and_linked(kernel, compiler) == (0, VARIANTS)


def test_another_compiler_or_other_flags_rebuild_everything(
    kernel: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    compiler = stand_in(tmp_path / "compiler")
    assert compiled_and_linked(kernel, compiler) == EVERYTHING
    stand_in(compiler, version="2")
    assert compiled_and_linked(kernel, compiler) == EVERYTHING
    monkeypatch.setattr(build_kernel, "COMPILE_FLAGS", (*build_kernel.COMPILE_FLAGS, "-DMORE"))
    assert compiled_and_linked(kernel, compiler) == EVERYTHING
    assert compiled_and_linked(kernel, compiler) == (0, 0)
    assert compiled_and_linked(kernel, stand_in(tmp_path / "other")) == EVERYTHING
    assert compiled_and_linked(kernel, tmp_path / "other", sanitize=True) == EVERYTHING


def test_outdated_files_do_not_pile_up(kernel: Path, tmp_path: Path) -> None:
    compiler = stand_in(tmp_path / "compiler")
    for text in ("// a", "// b", "// c"):
        (kernel / "one.cpp").write_text(text)
        compiled_and_linked(kernel, compiler)
    made = [path.name for path in (kernel.parents[2] / "out").iterdir()]
    assert len(made) == sum(EVERYTHING)


@pytest.mark.parametrize("step", ["*two.cpp", "-shared"])
def test_a_failed_build_leaves_nothing_that_looks_finished(
    kernel: Path, tmp_path: Path, step: str, capfd: pytest.CaptureFixture[str]
) -> None:
    broken = stand_in(tmp_path / "compiler", refused=step)
    with pytest.raises(KernelBuildError, match=r"^(compiling .*two\.cpp|linking libsplash_).* failed") as caught:
        compiled_and_linked(kernel, broken)
    assert "\n" not in str(caught.value)
    assert "stand-in: cannot" in capfd.readouterr().err
    left = [path.name for path in (kernel.parents[2] / "out").iterdir()]
    assert [name for name in left if not name.endswith(".o") or ("-two-" in name and step == "*two.cpp")] == []


def test_sources_that_are_not_there_are_an_error(tmp_path: Path) -> None:
    with pytest.raises(KernelBuildError, match="sources are not there"):
        build_kernel.build(TARGET, GCC, tmp_path / "out", root=tmp_path)


def test_a_library_in_use_is_replaced_and_not_overwritten(tmp_path: Path) -> None:
    new, old = tmp_path / "new", tmp_path / "folder" / "library"
    new.write_text("new")
    build_kernel.place(new, old)
    with old.open() as in_use:
        new.write_text("newer")
        build_kernel.place(new, old)
        assert in_use.read() == "new"
    assert old.read_text() == "newer"
    assert list(old.parent.iterdir()) == [old]


SOURCE = """
#include <cstring>
#include <stdexcept>
#include <thread>
#include <vector>
typedef float Floats __attribute__((vector_size(SPLASH_LANES * 4)));
extern "C" __attribute__((visibility("default"))) const char* variant() { return SPLASH_VARIANT; }
extern "C" __attribute__((visibility("default"))) float sum(float value, int lanes) {
    try {
        if (lanes != SPLASH_LANES) throw std::invalid_argument("lanes");
        std::vector<float> at(SPLASH_LANES, 0.0f);
        std::thread([&] { for (float& one : at) one = value; }).join();
        Floats all;
        std::memcpy(&all, at.data(), sizeof all);
        float total = 0.0f;
        for (int lane = 0; lane < SPLASH_LANES; ++lane) total += all[lane];
        return total;
    } catch (const std::exception&) {
        return -1.0f;
    }
}
"""


@pytest.fixture(scope="module")
def real(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """A small kernel, by the compiler that an installation here would use."""
    compiler = build_kernel.choose_compiler(TARGET, os.environ)
    if compiler.is_zig:
        pytest.skip("no C++ compiler here; zig takes minutes")
    root = tmp_path_factory.mktemp("real")
    (root / build_kernel.KERNEL).mkdir(parents=True)
    (root / build_kernel.KERNEL / "sum.cpp").write_text(SOURCE)
    return build_kernel.build(TARGET, compiler, root / "out", root=root)


def test_the_first_variant_runs_here(real: list[Path]) -> None:
    library = ctypes.CDLL(str(real[0]))
    library.variant.restype = ctypes.c_char_p
    library.sum.restype, library.sum.argtypes = ctypes.c_float, (ctypes.c_float, ctypes.c_int)
    assert library.variant().decode() == TARGET.variants[0].name
    assert library.sum(1.5, 4) == 6.0
    assert library.sum(1.5, 5) == -1.0  # an exception, caught inside


@pytest.mark.skipif(NATIVE_SYSTEM != "linux" or shutil.which("readelf") is None, reason="needs Linux and readelf")
def test_libraries_need_nothing_but_the_c_library(real: list[Path]) -> None:
    for library in real:
        done = subprocess.run(["readelf", "-d", str(library)], check=True, capture_output=True, text=True)
        needed = {line.partition("[")[2].partition(".so")[0] for line in done.stdout.splitlines() if "NEEDED" in line}
        assert needed <= {"libc", "libm", "libpthread", "ld-linux-x86-64", "ld-linux-aarch64"}


# --- What pip sees ---------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def checkout(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of what the build reads, without anything that was built."""
    setuptools = pytest.importorskip("setuptools", reason="the hooks need setuptools")
    if int(setuptools.__version__.split(".")[0]) < 77:
        pytest.skip(f"the hooks need setuptools 77, this is {setuptools.__version__}")
    copy = tmp_path_factory.mktemp("checkout")
    for name in ("pyproject.toml", "setup.py", "build_kernel.py", "MANIFEST.in", "README.md", "LICENSE"):
        shutil.copy2(ROOT / name, copy / name)
    for name in ("splashbench", "methods", "data_manifest", "leaderboards"):
        shutil.copytree(ROOT / name, copy / name, ignore=shutil.ignore_patterns("__pycache__", "libsplash_*"))
    return copy


def clean_environment() -> dict[str, str]:
    """That of this process, without a choice of compiler."""
    return {name: value for name, value in os.environ.items() if name not in ("CXX", "SPLASHBENCH_CXX", "PYTHONPATH")}


def hook(checkout: Path, call: str, path: Path, python_path: Path | None = None, choice: str = "") -> Done:
    """Call a hook as pip does, in a process of its own, with `path` for PATH and `choice` for SPLASHBENCH_CXX."""
    environ = {**clean_environment(), "PATH": str(path), "SPLASHBENCH_CXX": choice}
    if python_path is not None:
        environ["PYTHONPATH"] = str(python_path)
    code = f"import build_kernel; print(build_kernel.{call})"
    return subprocess.run(
        [sys.executable, "-W", "ignore", "-c", code], cwd=checkout, env=environ, capture_output=True, text=True
    )


@pytest.fixture(scope="module")
def compilers(tmp_path_factory: pytest.TempPathFactory) -> Path:
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
        done = hook(checkout, f"{name}()", path, choice=choice)
        assert done.returncode == 0, done.stderr
        return done.stdout.splitlines()[-1]

    assert required(compilers) == "[]"
    assert required(tmp_path) == f"['{build_kernel.ZIGLANG}']"
    assert required(compilers, choice="zig") == f"['{build_kernel.ZIGLANG}']"


def test_a_source_archive_needs_no_compiler(checkout: Path, tmp_path: Path) -> None:
    done = hook(checkout, "get_requires_for_build_sdist()", tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[-1] == "[]"


LIBRARIES = {f"splashbench/render/kernel/{TARGET.library(variant)}" for variant in TARGET.variants}


def built_wheel(done: Done, folder: Path) -> tuple[str, set[str], str]:
    """The one wheel in `folder`: the platform in its name, its files and what its WHEEL file says."""
    assert done.returncode == 0, done.stderr
    (path,) = folder.glob("*.whl")
    with zipfile.ZipFile(path) as archive:
        names = set(archive.namelist())
        (about,) = [name for name in names if name.endswith(".dist-info/WHEEL")]
        python, abi, platform = path.stem.split("-")[-3:]
        assert (python, abi) == ("py3", "none")
        return platform, names, archive.read(about).decode()


def test_the_wheel_of_the_systems_compiler(checkout: Path, compilers: Path, tmp_path: Path) -> None:
    platform, names, about = built_wheel(hook(checkout, f"build_wheel({str(tmp_path)!r})", compilers), tmp_path)
    assert platform == build_kernel.wheel_platform(TARGET, GCC)
    assert f"Tag: py3-none-{platform}" in about.splitlines()
    assert "Root-Is-Purelib: false" in about.splitlines()
    assert {name for name in names if "libsplash" in name} == LIBRARIES
    assert [name for name in names if name.endswith((".o", ".new")) or name.startswith("build")] == []


def test_the_wheel_of_zig(checkout: Path, zig: Path, tmp_path: Path) -> None:
    (empty := tmp_path / "empty").mkdir()
    done = hook(checkout, f"build_wheel({str(tmp_path)!r})", empty, zig)
    platform, names, _ = built_wheel(done, tmp_path)
    assert platform == build_kernel.wheel_platform(TARGET, ZIG)
    assert names >= LIBRARIES


def test_a_wheel_from_the_source_archive(checkout: Path, compilers: Path, tmp_path: Path) -> None:
    done = hook(checkout, f"build_sdist({str(tmp_path)!r})", compilers)
    assert done.returncode == 0, done.stderr
    (path,) = tmp_path.glob("*.tar.gz")
    with tarfile.open(path) as archive:
        assert [name for name in archive.getnames() if "libsplash" in name or "/build/" in name] == []
        if hasattr(tarfile, "data_filter"):
            archive.extractall(tmp_path, filter="data")
        else:
            archive.extractall(tmp_path)
    (unpacked,) = (folder for folder in tmp_path.iterdir() if folder.is_dir())
    _, names, _ = built_wheel(hook(unpacked, f"build_wheel({str(tmp_path)!r})", compilers), tmp_path)
    assert names >= LIBRARIES


def test_an_editable_installation_has_the_libraries_in_place(checkout: Path, compilers: Path, tmp_path: Path) -> None:
    done = hook(checkout, f"build_editable({str(tmp_path)!r})", compilers)
    built_wheel(done, tmp_path)
    in_place = {path.relative_to(checkout).as_posix() for path in (checkout / build_kernel.KERNEL).glob("libsplash_*")}
    assert in_place == LIBRARIES


def test_without_a_compiler_the_build_ends_in_one_clear_line(checkout: Path, tmp_path: Path) -> None:
    if importlib.util.find_spec("ziglang") is not None:
        pytest.skip("ziglang is installed here")
    done = hook(checkout, f"build_wheel({str(tmp_path)!r})", tmp_path)
    assert done.returncode != 0
    assert done.stderr.splitlines()[-1].startswith("error: no C++17 compiler with vector extensions was found")
    assert "Traceback" not in done.stderr
    assert list(tmp_path.iterdir()) == []


def test_a_broken_compiler_stops_the_question_for_requirements_in_one_line(checkout: Path, tmp_path: Path) -> None:
    done = hook(checkout, "get_requires_for_build_wheel()", tmp_path, choice="no-such-compiler")
    assert done.returncode != 0
    assert done.stderr.splitlines()[-1].startswith("error: SPLASHBENCH_CXX=no-such-compiler cannot")
    assert "Traceback" not in done.stderr


@pytest.mark.skipif(shutil.which("make") is None, reason="needs make")
def test_make_installs_anew_when_the_kernel_changed(tmp_path: Path) -> None:
    folder = tmp_path / build_kernel.KERNEL
    folder.mkdir(parents=True)
    (tmp_path / ".venv").mkdir()
    shutil.copy2(ROOT / "Makefile", tmp_path)
    seconds = itertools.count(1_000_000_000)

    def touch(path: Path) -> None:
        path.touch()
        now = next(seconds)
        os.utime(path, (now, now))

    names = ["pyproject.toml", "constraints.txt", "setup.py", "build_kernel.py", ".venv/ready"]
    installed = tmp_path / ".venv" / "installed-test"
    for path in (*(tmp_path / name for name in names), folder / "a.cpp", folder / "a.h", installed):
        touch(path)

    def up_to_date() -> bool:
        return subprocess.run(["make", "-q", ".venv/installed-test"], cwd=tmp_path).returncode == 0

    assert up_to_date()
    for name in ("a.cpp", "a.h"):
        touch(folder / name)
        assert not up_to_date()
        touch(installed)
        assert up_to_date()


@pytest.mark.slow
def test_installs_and_runs_where_there_is_no_compiler(checkout: Path, tmp_path: Path) -> None:
    """pip, with a PATH that has a few tools and no compiler: it fetches zig, which builds a kernel that runs."""
    tools = tmp_path / "tools"
    tools.mkdir()
    for name in ("sh", "uname", "cat", "ls", "rm", "mkdir"):
        found = shutil.which(name)
        assert found is not None
        (tools / name).symlink_to(found)
    venv.create(tmp_path / "venv", with_pip=True)
    python = tmp_path / "venv" / "bin" / "python"
    question = "import sysconfig; print(sysconfig.get_path('platlib'))"
    site = subprocess.run([python, "-c", question], check=True, capture_output=True, text=True).stdout.strip()
    # The dependencies are those of this environment; the package itself and its compiler are the new one's.
    here = importlib.metadata.distribution("numpy").locate_file("")
    Path(site, "dependencies.pth").write_text(f"{here}\n", encoding="utf-8")
    environ = clean_environment()
    environ["PATH"] = os.pathsep.join([str(python.parent), str(tools)])
    assert choose(environ) is ZIG
    pip = [str(python), "-m", "pip", "install", "--disable-pip-version-check", "--no-deps", "--force-reinstall"]
    done = subprocess.run([*pip, str(checkout)], env=environ, cwd=tmp_path, capture_output=True, text=True)
    if done.returncode != 0 and "ziglang" in done.stderr and "No matching distribution" in done.stderr:
        pytest.skip("pip cannot fetch ziglang here")
    assert done.returncode == 0, done.stdout + done.stderr
    code = (
        "import importlib.metadata as m, splashbench.render.native as n;"
        "print(m.distribution('splashbench').read_text('WHEEL')); print(n.__file__); print(n.variant())"
    )
    done = subprocess.run([python, "-c", code], env=environ, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    *about, file, variant = done.stdout.splitlines()
    assert f"Tag: py3-none-{build_kernel.wheel_platform(TARGET, ZIG)}" in about
    assert file.startswith(str(tmp_path))
    assert variant in {of_target.name for of_target in TARGET.variants}
