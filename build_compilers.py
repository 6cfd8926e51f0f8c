"""What the kernels are compiled with: the variants, the table of flags, and the choice of a compiler.

build_kernel.py does the compiling. Where there is no C++ compiler, the `ziglang` package is one.
"""

from __future__ import annotations

import importlib.metadata
import os
import shlex
import shutil
import subprocess
import sys
import sysconfig
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

PLATFORM = "linux-x86_64"  # as sysconfig.get_platform() calls it
ZIGLANG = "ziglang==0.17.0"  # constraints.txt has the same


class KernelBuildError(Exception):
    """A kernel cannot be built. The message is one line: what is wrong, and what to do."""


def check_platform(name: str | None = None) -> None:
    """Raise KernelBuildError where this Python (or `name`) is not for Linux on x86-64.

    Builders that cross-compile set _PYTHON_HOST_PLATFORM, which sysconfig obeys.
    """
    name = sysconfig.get_platform() if name is None else name
    if name != PLATFORM:
        raise KernelBuildError(f"{name}: splashbench's compiled kernels are for Linux on x86-64 only")


@dataclass(frozen=True)
class KernelVariant:
    """A kind of processor, for which each kernel becomes a library; splashbench/native/library.py picks one."""

    name: str
    lanes: int  # floats per vector
    instructions: tuple[str, ...]  # flags of gcc and clang
    zig_cpu: tuple[str, ...]  # the same for zig, which spells processors its own way

    @property
    def defines(self) -> tuple[str, ...]:
        return (f"-DSPLASH_LANES={self.lanes}", f'-DSPLASH_VARIANT="{self.name}"')


# clang cuts 512-bit vectors in two unless told that they are wanted; gcc knows the flag and needs no telling.
_FULL_WIDTH = "-mprefer-vector-width=512"

# The first variant runs on every processor, and says which of the others this one can run.
VARIANTS = (
    KernelVariant("baseline", 4, ("-march=x86-64",), ("-mcpu=x86_64",)),
    KernelVariant("avx2", 8, ("-march=x86-64-v3",), ("-mcpu=x86_64_v3",)),
    KernelVariant("avx512", 16, ("-march=x86-64-v4", _FULL_WIDTH), ("-mcpu=x86_64_v4", _FULL_WIDTH)),
)

COMPILE_FLAGS = (
    "-std=c++17",
    "-O3",
    # Parts of -ffast-math that let loops become vectors and products become multiply-adds. Never all of it: it would
    # cancel the kernel's rounding by adding and subtracting a large number, and assume away NaN and infinity.
    "-fno-math-errno",
    "-fno-trapping-math",
    "-freciprocal-math",
    "-fno-signed-zeros",
    "-ffp-contract=fast",
    "-fvisibility=hidden",  # the C interface alone is exported
    "-fPIC",
    "-pthread",
    "-Wall",
    "-Wextra",
    "-Wno-maybe-uninitialized",  # gcc 12 says it of its own AVX-512 header
    "-Wno-unknown-warning-option",  # clang has no such warning
    "-Isplashbench",  # from the root of the source tree: #include "native/simd.h"
)
# Every product and every sum of these is rounded for itself: all variants give the same bits.
EXACT_SOURCES = ("splashbench/gaussians/kernel/ssim.cpp",)
EXACT_FLAGS = ("-ffp-contract=off", "-fno-reciprocal-math")  # after COMPILE_FLAGS, to replace two of these
LINK_FLAGS = ("-shared", "-pthread", "-s")  # -s: names of static functions are two thirds of the file
# The C++ library inside, so that no other one is needed or met at run time. zig always does that.
STATIC_FLAGS = ("-static-libstdc++", "-static-libgcc", "-Wl,--exclude-libs,ALL")
SANITIZE_FLAGS = (
    "-O1",  # after -O3, which it replaces
    "-g",
    "-fno-omit-frame-pointer",
    "-fsanitize=address,undefined",
    "-fno-sanitize-recover=undefined",
    "-D_GLIBCXX_ASSERTIONS",  # bounds of vectors
)
ZIG_TARGET = ("-target", "x86_64-linux-gnu.2.17")  # the glibc that makes a wheel manylinux_2_17


@dataclass(frozen=True)
class Compiler:
    """A command that compiles and links C++, and the flags that it takes."""

    command: tuple[str, ...]
    is_zig: bool = False
    static: bool = True  # it has the C++ library in static form

    def compile_flags(
        self, variant: KernelVariant, sanitize: bool = False, source: Path | None = None
    ) -> tuple[str, ...]:
        processor = (*ZIG_TARGET, *variant.zig_cpu) if self.is_zig else variant.instructions
        exact = EXACT_FLAGS if source is not None and source.as_posix() in EXACT_SOURCES else ()
        return (*processor, *COMPILE_FLAGS, *exact, *(SANITIZE_FLAGS if sanitize else ()), *variant.defines)

    def link_flags(self, sanitize: bool = False) -> tuple[str, ...]:
        # No processor here: zig compiles its C++ library when it links, once for all variants if they link alike.
        if sanitize:  # shares the C++ library with Python, whose exceptions the sanitizer watches; keeps its names
            return (*(flag for flag in LINK_FLAGS if flag != "-s"), *SANITIZE_FLAGS)
        if self.is_zig:
            return (*ZIG_TARGET, "-O3", *LINK_FLAGS)
        return (*LINK_FLAGS, *STATIC_FLAGS) if self.static else LINK_FLAGS

    def identity(self) -> str:
        """What tells this compiler from another one, or from its next version."""
        if self.is_zig:
            return f"ziglang {importlib.metadata.version('ziglang')}"
        version = subprocess.run([*self.command, "--version"], capture_output=True, text=True, errors="replace")
        return f"{shlex.join(self.command)} {version.stdout}"

    @property
    def wheel_platform(self) -> str:
        """The platform tag of a wheel with libraries from this compiler."""
        # A system's compiler links against that system's glibc, whatever its age.
        return "manylinux_2_17_x86_64" if self.is_zig else "linux_x86_64"


ZIG = Compiler((sys.executable, "-m", "ziglang", "c++"), is_zig=True)
ON_PATH = ("c++", "g++", "clang++")  # in this order

# What the kernels ask of a compiler: vector extensions with selection, C++17, threads, exceptions.
PROBE = """
#if !defined(__linux__) || !defined(__x86_64__)
#error for another target
#endif
#include <atomic>
#include <stdexcept>
#include <thread>
#include <vector>
typedef float Floats __attribute__((vector_size(SPLASH_LANES * 4)));
extern "C" __attribute__((visibility("default"))) float probe(const float* at) {
    if constexpr (SPLASH_LANES < 4) throw std::runtime_error(SPLASH_VARIANT);
    Floats all = Floats{} + *at;
    all = all > 1.0f ? all : -all;
    std::atomic<int> calls{0};
    std::vector<std::thread> threads;
    threads.emplace_back([&] { ++calls; });
    threads.back().join();
    return all[0] + calls;
}
"""


def can_build(compiler: Compiler) -> bool:
    """Whether the compiler makes a shared library of a small program for the last, most demanding variant."""
    with tempfile.TemporaryDirectory(prefix="splashbench-probe-") as folder:
        source, library = Path(folder, "probe.cpp"), Path(folder, "probe.out")
        source.write_text(PROBE, encoding="utf-8")
        flags = (*compiler.compile_flags(VARIANTS[-1]), *compiler.link_flags())
        command = [*compiler.command, *flags, str(source), "-o", str(library)]
        try:
            outcome = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, timeout=60, cwd=folder)
        except (OSError, subprocess.TimeoutExpired):
            return False
        return outcome.returncode == 0 and library.is_file()


def choose_compiler(environ: Mapping[str, str]) -> Compiler:
    """SPLASHBENCH_CXX (a command, or `zig`), else CXX, else the first on PATH that works, else zig.

    Raises KernelBuildError where a compiler that the environment names does not work. Whether zig is installed is not
    looked at: pip has yet to install it when it asks what the build needs.
    """
    for name in ("SPLASHBENCH_CXX", "CXX"):
        command = tuple(shlex.split(environ.get(name, "")))
        if command == ("zig",):
            return ZIG
        if command:
            compiler = _working(command)
            if compiler is None:
                raise KernelBuildError(
                    f"{name}={environ[name]} cannot compile C++17 with vector extensions for {VARIANTS[-1].name}; "
                    "name another compiler, or set SPLASHBENCH_CXX=zig for the one that pip can install"
                )
            return compiler
    for name in ON_PATH:
        path = shutil.which(name, path=environ.get("PATH", os.defpath))
        compiler = _working((path,)) if path else None
        if compiler is not None:
            return compiler
    return ZIG


def _working(command: tuple[str, ...]) -> Compiler | None:
    # Some distributions keep the static C++ library in a package of its own; the shared one will do there.
    candidates = (Compiler(command), Compiler(command, static=False))
    return next((compiler for compiler in candidates if can_build(compiler)), None)


def installed_compiler(environ: Mapping[str, str]) -> Compiler:
    """The chosen compiler, which is there. Raises KernelBuildError where it is not."""
    compiler = choose_compiler(environ)
    if compiler.is_zig:
        try:
            importlib.metadata.version("ziglang")
        except importlib.metadata.PackageNotFoundError:
            raise KernelBuildError(
                "no C++17 compiler with vector extensions was found: install g++ 11 or clang++ 12 or newer "
                f"(Debian, Ubuntu: apt install g++), or pip install {ZIGLANG}"
            ) from None
    return compiler
