"""Which compiler builds the kernels, with which flags, and for which platform the wheel says it is."""

from __future__ import annotations

import importlib.metadata
from collections.abc import Callable
from pathlib import Path

import pytest

from build_compilers import (
    EXACT_SOURCES,
    VARIANTS,
    ZIG,
    ZIGLANG,
    Compiler,
    KernelBuildError,
    KernelVariant,
    check_platform,
    choose_compiler,
    installed_compiler,
)

ROOT = Path(__file__).parents[2]
GCC = Compiler(("g++",))
StandIn = Callable[..., Path]
Calls = Callable[[Path], list[str]]


def test_the_environment_goes_before_the_path(tmp_path: Path, stand_in: StandIn) -> None:
    mine, usual = stand_in(tmp_path / "mine"), stand_in(tmp_path / "usual")
    on_path = stand_in(tmp_path / "bin" / "c++")
    environ = {"SPLASHBENCH_CXX": str(mine), "CXX": str(usual), "PATH": str(on_path.parent)}
    assert choose_compiler(environ).command == (str(mine),)
    del environ["SPLASHBENCH_CXX"]
    assert choose_compiler(environ).command == (str(usual),)
    del environ["CXX"]
    assert choose_compiler(environ).command == (str(on_path),)


def test_zig_can_be_asked_for_beside_a_working_compiler(tmp_path: Path, stand_in: StandIn, calls: Calls) -> None:
    on_path = stand_in(tmp_path / "c++")
    assert choose_compiler({"SPLASHBENCH_CXX": "zig", "PATH": str(tmp_path)}) is ZIG
    assert calls(on_path) == []


def test_a_named_compiler_may_have_arguments(tmp_path: Path, stand_in: StandIn, calls: Calls) -> None:
    compiler = stand_in(tmp_path / "compiler")
    assert choose_compiler({"CXX": f"{compiler} --sysroot='a b'"}).command == (str(compiler), "--sysroot=a b")
    assert "--sysroot=a b -" in calls(compiler)[0]


def test_compilers_on_the_path_that_cannot_build_are_passed_over(tmp_path: Path, stand_in: StandIn) -> None:
    stand_in(tmp_path / "c++", refused="-o")
    last = stand_in(tmp_path / "clang++")
    assert choose_compiler({"PATH": str(tmp_path)}).command == (str(last),)


def test_the_probe_asks_for_the_most_demanding_variant(tmp_path: Path, stand_in: StandIn) -> None:
    hardest = VARIANTS[-1]
    stand_in(tmp_path / "c++", refused=f"-DSPLASH_LANES={hardest.lanes}")
    assert choose_compiler({"PATH": str(tmp_path)}) is ZIG


def test_a_compiler_without_a_static_library_links_the_shared_one(tmp_path: Path, stand_in: StandIn) -> None:
    stand_in(tmp_path / "c++", refused="-static-libstdc++")
    compiler = choose_compiler({"PATH": str(tmp_path)})
    assert compiler.command == (str(tmp_path / "c++"),)
    assert [flag for flag in compiler.link_flags() if "static" in flag] == []
    assert "-static-libstdc++" in GCC.link_flags()


def test_without_a_compiler_it_is_zig(tmp_path: Path) -> None:
    assert choose_compiler({"PATH": str(tmp_path)}) is ZIG


@pytest.mark.parametrize("name", ["SPLASHBENCH_CXX", "CXX"])
@pytest.mark.parametrize("fault", ["missing", "broken"])
def test_a_named_compiler_that_cannot_build_is_an_error(
    tmp_path: Path, stand_in: StandIn, name: str, fault: str
) -> None:
    stand_in(tmp_path / "broken", refused="-o")
    stand_in(tmp_path / "c++")
    with pytest.raises(KernelBuildError, match=rf"^{name}=.*{fault} cannot .*SPLASHBENCH_CXX=zig") as caught:
        choose_compiler({name: str(tmp_path / fault), "PATH": str(tmp_path)})
    assert "\n" not in str(caught.value)


def test_no_compiler_and_no_zig_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def version(name: str) -> str:
        raise importlib.metadata.PackageNotFoundError(name)

    monkeypatch.setattr(importlib.metadata, "version", version)
    with pytest.raises(KernelBuildError, match=r"^no C\+\+17 compiler .*g\+\+.*pip install ziglang==[\d.]+$"):
        installed_compiler({"PATH": str(tmp_path)})


def test_the_constraints_pin_the_same_zig() -> None:
    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    assert [line for line in lines if line.startswith("ziglang")] == [ZIGLANG]


@pytest.mark.parametrize(
    "name", ["linux-aarch64", "linux-i686", "linux-riscv64", "macosx-14.0-arm64", "win-amd64", "freebsd-14.0-amd64"]
)
def test_another_platform_is_an_error_that_names_it(name: str) -> None:
    with pytest.raises(KernelBuildError, match=rf"^{name}: .* for Linux on x86-64 only$"):
        check_platform(name)


def test_the_platform_of_these_tests_is_supported() -> None:
    check_platform()
    check_platform("linux-x86_64")


def test_variants() -> None:
    assert [(variant.name, variant.lanes) for variant in VARIANTS] == [("baseline", 4), ("avx2", 8), ("avx512", 16)]
    assert [variant.instructions[0] for variant in VARIANTS] == [
        "-march=x86-64",
        "-march=x86-64-v3",
        "-march=x86-64-v4",
    ]
    assert [variant.zig_cpu[0] for variant in VARIANTS] == ["-mcpu=x86_64", "-mcpu=x86_64_v3", "-mcpu=x86_64_v4"]


def test_the_wheel_names_the_oldest_glibc_it_runs_with() -> None:
    assert GCC.wheel_platform == "linux_x86_64"
    assert ZIG.wheel_platform == "manylinux_2_17_x86_64"
    for flags in (ZIG.link_flags(), *(ZIG.compile_flags(variant) for variant in VARIANTS)):
        assert flags[:2] == ("-target", "x86_64-linux-gnu.2.17")


@pytest.mark.parametrize("compiler", [GCC, ZIG])
@pytest.mark.parametrize("variant", VARIANTS)
def test_flags_keep_the_rounding_that_the_code_states(compiler: Compiler, variant: KernelVariant) -> None:
    flags = compiler.compile_flags(variant)
    assert {"-O3", "-std=c++17", "-fPIC", f"-DSPLASH_LANES={variant.lanes}"} <= set(flags)
    assert not {"-ffast-math", "-Ofast", "-ffinite-math-only", "-fassociative-math"} & set(flags)


@pytest.mark.parametrize("compiler", [GCC, ZIG])
def test_sources_that_give_the_same_bits_everywhere_have_no_multiply_adds(compiler: Compiler) -> None:
    (exact,) = map(Path, EXACT_SOURCES)
    assert (ROOT / exact).is_file()
    for flags in (compiler.compile_flags(VARIANTS[0], False, exact), compiler.compile_flags(VARIANTS[2], True, exact)):
        assert flags.index("-ffp-contract=off") > flags.index("-ffp-contract=fast")
        assert flags.index("-fno-reciprocal-math") > flags.index("-freciprocal-math")
    assert "-ffp-contract=off" not in compiler.compile_flags(VARIANTS[0], False, exact.with_name("api.cpp"))


@pytest.mark.parametrize("compiler", [GCC, ZIG])
@pytest.mark.parametrize("variant", VARIANTS)
def test_sanitizers_watch_both_steps_and_names_stay(compiler: Compiler, variant: KernelVariant) -> None:
    flags = [*compiler.compile_flags(variant, sanitize=True), *compiler.link_flags(sanitize=True)]
    assert flags.count("-fsanitize=address,undefined") == 2
    assert "-s" not in flags
    assert "-s" in compiler.link_flags()
