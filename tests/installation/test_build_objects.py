"""Which kernels are built, what is built again after a change, and what a library needs to run."""

from __future__ import annotations

import ctypes
import os
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

import build_compilers
import build_kernel
from build_compilers import VARIANTS, Compiler, KernelBuildError, choose_compiler

RENDERER = Path("splashbench/render/kernel")
METHOD = Path("methods/foam/kernel")


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    """A source tree with a kernel of two files and a header, a method's kernel of one, and a shared file and header."""
    root = tmp_path / "tree"
    for folder, names in {
        RENDERER: ("one.cpp", "two.cpp", "own.h"),
        METHOD: ("foam.cpp", "own.h"),
        build_kernel.NATIVE: ("threads.cpp", "threads.h"),
    }.items():
        (root / folder).mkdir(parents=True)
        for name in names:
            (root / folder / name).write_text(f"// {name}\n", encoding="utf-8")
    return root


@pytest.fixture
def compiler(tmp_path: Path, stand_in: Callable[..., Path]) -> Path:
    return stand_in(tmp_path / "compiler")


Steps = Callable[..., tuple[int, int]]


@pytest.fixture
def steps(tree: Path, calls: Callable[[Path], list[str]]) -> Steps:
    """Builds the tree with a compiler, and counts its calls that compile and those that link."""

    def build(compiler: Path, **options: object) -> tuple[int, int]:
        libraries = build_kernel.build(Compiler((str(compiler),)), tree / "out", root=tree, **options)
        assert [library.read_text() for library in libraries.values()] == ["made\n"] * 2 * len(VARIANTS)
        lines = calls(compiler)
        return sum(" -c " in line for line in lines), sum(" -c " not in line for line in lines)

    return build


EACH = len(VARIANTS)
EVERYTHING = (4 * EACH, 2 * EACH)  # the shared source is compiled once for both kernels


def test_a_folder_of_sources_in_a_room_or_a_method_is_a_kernel(tree: Path) -> None:
    method, renderer = build_kernel.kernels(tree)
    assert (method.folder, method.name, renderer.folder, renderer.name) == (METHOD, "foam", RENDERER, "render")
    assert method.sources(tree) == [METHOD / "foam.cpp", build_kernel.NATIVE / "threads.cpp"]
    assert method.headers(tree) == [METHOD / "own.h", build_kernel.NATIVE / "threads.h"]
    assert method.library(VARIANTS[1]) == METHOD / "libfoam_avx2.so"


def test_the_kernels_of_this_checkout() -> None:
    names = [kernel.name for kernel in build_kernel.kernels()]
    assert names == ["scaffold_gs", "splashsplat", "gaussians", "observe", "render"]
    assert build_kernel.headers_for(build_kernel.NATIVE)


def test_two_kernels_of_one_name_are_an_error(tree: Path) -> None:
    shutil.copytree(tree / METHOD, tree / "splashbench" / "foam" / "kernel")
    with pytest.raises(
        KernelBuildError, match=r"^splashbench/foam/kernel and methods/foam/kernel make the same library"
    ):
        build_kernel.kernels(tree)


def test_every_kernel_is_built_for_every_variant(tree: Path, compiler: Path) -> None:
    libraries = build_kernel.build(Compiler((str(compiler),)), tree / "out", root=tree)
    places = [
        f"{folder}/lib{name}_{variant}.so"
        for folder, name in ((METHOD, "foam"), (RENDERER, "render"))
        for variant in ("baseline", "avx2", "avx512")
    ]
    assert [library.as_posix() for library in libraries] == places
    assert len(set(libraries.values())) == len(places)


def test_a_kernel_is_linked_from_its_own_and_the_shared_sources(
    tree: Path, compiler: Path, calls: Callable[[Path], list[str]]
) -> None:
    build_kernel.build(Compiler((str(compiler),)), tree / "out", VARIANTS[:1], root=tree)
    links = [line for line in calls(compiler) if " -c " not in line]
    objects = [sorted(Path(word).name.split("-")[1] for word in line.split() if word.endswith(".o")) for line in links]
    shared = "splashbench.native.threads"
    assert objects == [
        ["methods.foam.kernel.foam", shared],
        [shared, "splashbench.render.kernel.one", "splashbench.render.kernel.two"],
    ]


def test_only_what_changed_is_rebuilt(tree: Path, compiler: Path, steps: Steps) -> None:
    kernel = tree / RENDERER
    assert steps(compiler) == EVERYTHING
    assert steps(compiler) == (0, 0)
    os.utime(kernel / "one.cpp")
    assert steps(compiler) == (0, 0)
    (kernel / "one.cpp").write_text("// another one\n")
    assert steps(compiler) == (EACH, EACH)
    (kernel / "own.h").write_text("// another header\n")
    assert steps(compiler) == (2 * EACH, EACH)
    (kernel / "more.h").write_text("// a new header\n")
    assert steps(compiler) == (2 * EACH, EACH)
    (kernel / "two.cpp").unlink()
    assert steps(compiler) == (0, EACH)
    (tree / build_kernel.NATIVE / "threads.cpp").write_text("// other threads\n")
    assert steps(compiler) == (EACH, 2 * EACH)
    (tree / build_kernel.NATIVE / "threads.h").write_text("// another shared header\n")
    assert steps(compiler) == (3 * EACH, 2 * EACH)


def test_another_compiler_or_other_flags_rebuild_everything(
    compiler: Path, steps: Steps, stand_in: Callable[..., Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert steps(compiler) == EVERYTHING
    stand_in(compiler, version="2")
    assert steps(compiler) == EVERYTHING
    monkeypatch.setattr("build_compilers.COMPILE_FLAGS", (*build_compilers.COMPILE_FLAGS, "-DMORE"))
    assert steps(compiler) == EVERYTHING
    assert steps(compiler) == (0, 0)
    other = stand_in(compiler.with_name("other"))
    assert steps(other) == EVERYTHING
    assert steps(other, sanitize=True) == EVERYTHING


def test_outdated_files_do_not_pile_up(tree: Path, compiler: Path, steps: Steps) -> None:
    for text in ("// a", "// b", "// c"):
        (tree / RENDERER / "one.cpp").write_text(text)
        steps(compiler)
    assert len(list((tree / "out").iterdir())) == sum(EVERYTHING)


@pytest.mark.parametrize("step", ["*two.cpp", "-shared"])
def test_a_failed_build_leaves_nothing_that_looks_finished(
    tree: Path,
    tmp_path: Path,
    step: str,
    steps: Steps,
    stand_in: Callable[..., Path],
    capfd: pytest.CaptureFixture[str],
) -> None:
    broken = stand_in(tmp_path / "broken", refused=step)
    with pytest.raises(KernelBuildError, match=r"^(compiling .*two\.cpp|linking libfoam_).* failed") as caught:
        steps(broken)
    assert "\n" not in str(caught.value)
    assert "stand-in: cannot" in capfd.readouterr().err
    names = [path.name for path in (tree / "out").iterdir()]
    assert [name for name in names if not name.endswith(".o") or (".two-" in name and step == "*two.cpp")] == []


def test_sources_that_are_not_there_are_an_error(tmp_path: Path) -> None:
    with pytest.raises(KernelBuildError, match="sources are not there"):
        build_kernel.kernels(tmp_path)


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
def libraries(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """A small kernel's, by the compiler that an installation here would use."""
    compiler = choose_compiler(os.environ)
    if compiler.is_zig:
        pytest.skip("no C++ compiler here; zig takes minutes")
    root = tmp_path_factory.mktemp("real")
    (root / METHOD).mkdir(parents=True)
    (root / METHOD / "sum.cpp").write_text(SOURCE)
    return list(build_kernel.build(compiler, root / "out", root=root).values())


def test_the_first_variant_runs_here(libraries: list[Path]) -> None:
    library = ctypes.CDLL(str(libraries[0]))
    library.variant.restype = ctypes.c_char_p
    library.sum.restype, library.sum.argtypes = ctypes.c_float, (ctypes.c_float, ctypes.c_int)
    assert library.variant().decode() == VARIANTS[0].name
    assert library.sum(1.5, 4) == 6.0
    assert library.sum(1.5, 5) == -1.0  # an exception, caught inside


@pytest.mark.skipif(shutil.which("readelf") is None, reason="needs readelf")
def test_libraries_need_nothing_but_the_c_library(libraries: list[Path]) -> None:
    for library in libraries:
        listing = subprocess.run(["readelf", "-d", str(library)], check=True, capture_output=True, text=True).stdout
        needed = {line.partition("[")[2].partition(".so")[0] for line in listing.splitlines() if "NEEDED" in line}
        assert "libc" in needed
        assert needed <= {"libc", "libm", "libpthread", "ld-linux-x86-64"}
