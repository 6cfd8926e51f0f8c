"""Builds the renderer's C++ kernel: the table of flags, the choice of a compiler, and the hooks that pip calls.

pip, in an environment of its own, asks this module what the build needs and has setuptools run setup.py, which comes
back here for the compiling. Where there is no C++ compiler, the `ziglang` package is one. In a checkout,
`python build_kernel.py` builds in place, and `--help` says what else it can do.
"""

from __future__ import annotations

import argparse
import hashlib
import importlib.metadata
import os
import platform
import shlex
import shutil
import subprocess
import sys
import sysconfig
import tempfile
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent
KERNEL = Path("splashbench") / "render" / "kernel"  # in the checkout, and below the site-packages folder
ZIGLANG = "ziglang==0.17.0"  # constraints.txt has the same


class KernelBuildError(Exception):
    """The kernel cannot be built. The message is one line: what is wrong, and what to do."""


# --- The table -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Variant:
    """The kernel for one kind of processor: a shared library that splashbench/render/native.py picks at load time."""

    name: str
    lanes: int  # floats per vector
    instructions: tuple[str, ...]  # flags of gcc and clang
    zig_cpu: tuple[str, ...]  # the same for zig, which spells processors its own way

    @property
    def defines(self) -> tuple[str, ...]:
        return (f"-DSPLASH_LANES={self.lanes}", f'-DSPLASH_VARIANT="{self.name}"')


# clang cuts 512-bit vectors in two unless told that they are wanted; gcc knows the flag and needs no telling.
_FULL_WIDTH = "-mprefer-vector-width=512"

# By processor. The first variant runs on every processor of its kind, and says which of the others this one can run.
VARIANTS = {
    "x86_64": (
        Variant("baseline", 4, ("-march=x86-64",), ("-mcpu=x86_64",)),
        Variant("avx2", 8, ("-march=x86-64-v3",), ("-mcpu=x86_64_v3",)),
        Variant("avx512", 16, ("-march=x86-64-v4", _FULL_WIDTH), ("-mcpu=x86_64_v4", _FULL_WIDTH)),
    ),
    "arm64": (Variant("neon", 4, (), ()),),
}

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
    "-Wall",
    "-Wextra",
    "-Wno-maybe-uninitialized",  # gcc 12 says it of its own AVX-512 header
    "-Wno-unknown-warning-option",  # clang has no such warning
)
SANITIZE_FLAGS = (
    "-O1",  # after -O3, which it replaces
    "-g",
    "-fno-omit-frame-pointer",
    "-fsanitize=address,undefined",
    "-fno-sanitize-recover=undefined",
    "-D_GLIBCXX_ASSERTIONS",  # bounds of vectors
)


@dataclass(frozen=True)
class System:
    """What an operating system asks of a shared library."""

    macro: str  # that compilers for it define
    suffix: str
    compile_flags: tuple[str, ...]
    link_flags: tuple[str, ...]
    # The C++ library inside, so that no other one is needed or met at run time. zig always does that.
    static_flags: tuple[str, ...]
    compilers: tuple[str, ...]  # looked for on PATH, in this order
    zig_system: str  # the second half of zig's -target


SYSTEMS = {
    "linux": System(
        macro="__linux__",
        suffix=".so",
        compile_flags=("-fPIC", "-pthread"),
        link_flags=("-shared", "-pthread", "-s"),  # -s: names of static functions are two thirds of the file
        static_flags=("-static-libstdc++", "-static-libgcc", "-Wl,--exclude-libs,ALL"),
        compilers=("c++", "g++", "clang++"),
        zig_system="linux-gnu.2.17",  # the glibc that makes a wheel manylinux_2_17
    ),
    "macosx": System(
        macro="__APPLE__",
        suffix=".dylib",
        compile_flags=("-fPIC", "-pthread", "-mmacosx-version-min=11.0"),
        link_flags=("-shared", "-pthread", "-mmacosx-version-min=11.0"),
        static_flags=(),  # the system's own C++ library is part of its interface
        compilers=("c++", "clang++"),
        zig_system="macos.11.0",
    ),
    "win": System(
        macro="_WIN32",
        suffix=".dll",
        compile_flags=(),
        link_flags=("-shared",),
        static_flags=(),
        compilers=("clang++",),  # MSVC has no vector extensions
        zig_system="windows-gnu",
    ),
}


@dataclass(frozen=True)
class Target:
    """What is built for: `system` is a key of SYSTEMS, `machine` one of VARIANTS."""

    system: str
    machine: str

    @property
    def macros(self) -> tuple[str, str]:
        """What every compiler for this target defines, and no other one."""
        return SYSTEMS[self.system].macro, "__aarch64__" if self.machine == "arm64" else "__x86_64__"

    @property
    def variants(self) -> tuple[Variant, ...]:
        return VARIANTS[self.machine]

    @property
    def zig(self) -> str:
        return f"{'aarch64' if self.machine == 'arm64' else self.machine}-{SYSTEMS[self.system].zig_system}"

    def library(self, variant: Variant) -> str:
        """The library's file name; splashbench/render/native.py looks for it."""
        return f"libsplash_{variant.name}{SYSTEMS[self.system].suffix}"


def target_of(name: str, machine: str) -> Target:
    """The target that `sysconfig.get_platform()` calls `name`; `machine` where that leaves the processor open."""
    system, _, rest = name.partition("-")
    found = rest.rpartition("-")[2]
    found = {"amd64": "x86_64", "aarch64": "arm64"}.get(found, found)
    if found in ("universal2", "intel"):  # a Python for both processors of a Mac
        found = machine
    if system not in SYSTEMS or found not in VARIANTS:
        raise KernelBuildError(
            f"{name}: the renderer's kernel is made for Linux, macOS and Windows on x86-64 and arm64 only"
        )
    return Target(system, found)


def this_target() -> Target:
    """The target of this Python. Builders that cross-compile set _PYTHON_HOST_PLATFORM, which sysconfig obeys."""
    return target_of(sysconfig.get_platform(), platform.machine().lower())


# --- The compiler ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Compiler:
    """A command that compiles and links C++, and what it has to be told apart from the table."""

    command: tuple[str, ...]
    is_zig: bool = False
    static: bool = True  # it has the C++ library in static form

    def compile_flags(self, target: Target, variant: Variant, sanitize: bool = False) -> tuple[str, ...]:
        goal = ("-target", target.zig, *variant.zig_cpu) if self.is_zig else variant.instructions
        extra = SANITIZE_FLAGS if sanitize else ()
        return (*goal, *COMPILE_FLAGS, *extra, *SYSTEMS[target.system].compile_flags, *variant.defines)

    def link_flags(self, target: Target, sanitize: bool = False) -> tuple[str, ...]:
        # No processor here: zig compiles its C++ library when it links, once for all variants if they link alike.
        system = SYSTEMS[target.system]
        flags = system.link_flags
        if sanitize:  # shares the C++ library with Python, whose exceptions the sanitizer watches; keeps its names
            return (*(flag for flag in flags if flag != "-s"), *SANITIZE_FLAGS)
        if self.is_zig:
            return ("-target", target.zig, "-O3", *flags)
        return (*flags, *system.static_flags) if self.static else flags

    def identity(self) -> str:
        """What tells this compiler from another one, or from its next version."""
        if self.is_zig:
            return f"ziglang {importlib.metadata.version('ziglang')}"
        done = subprocess.run([*self.command, "--version"], capture_output=True, text=True, errors="replace")
        return f"{shlex.join(self.command)} {done.stdout}"


ZIG = Compiler((sys.executable, "-m", "ziglang", "c++"), is_zig=True)

# What the kernel asks of a compiler: vector extensions with selection, C++17, threads, exceptions.
PROBE = """
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


def can_build(compiler: Compiler, target: Target) -> bool:
    """Whether the compiler makes a shared library of a small program for the last, most demanding variant."""
    with tempfile.TemporaryDirectory(prefix="splashbench-probe-") as folder:
        source, library = Path(folder, "probe.cpp"), Path(folder, "probe.out")
        lines = [f"#ifndef {macro}\n#error for another target\n#endif" for macro in target.macros]
        source.write_text("\n".join([*lines, PROBE]), encoding="utf-8")
        flags = (*compiler.compile_flags(target, target.variants[-1]), *compiler.link_flags(target))
        command = [*compiler.command, *flags, str(source), "-o", str(library)]
        try:
            done = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, timeout=60, cwd=folder)
        except (OSError, subprocess.TimeoutExpired):
            return False
        return done.returncode == 0 and library.is_file()


def choose_compiler(target: Target, environ: Mapping[str, str]) -> Compiler:
    """SPLASHBENCH_CXX (a command, or `zig`), else CXX, else the first on PATH that works, else zig.

    Raises KernelBuildError where a compiler that the environment names does not work. Whether zig is installed is not
    looked at: pip has yet to install it when it asks what the build needs.
    """
    for name in ("SPLASHBENCH_CXX", "CXX"):
        words = tuple(shlex.split(environ.get(name, ""), posix=os.name == "posix"))
        if words == ("zig",):
            return ZIG
        if words:
            found = _working(words, target)
            if found is None:
                raise KernelBuildError(
                    f"{name}={environ[name]} cannot compile C++17 with vector extensions for "
                    f"{target.variants[-1].name}; name another compiler, or set SPLASHBENCH_CXX=zig for the one "
                    "that pip can install"
                )
            return found
    for name in SYSTEMS[target.system].compilers:
        path = shutil.which(name, path=environ.get("PATH", os.defpath))
        found = _working((path,), target) if path else None
        if found is not None:
            return found
    return ZIG


def _working(command: tuple[str, ...], target: Target) -> Compiler | None:
    # Some distributions keep the static C++ library in a package of its own; the shared one will do there.
    variants = (Compiler(command), Compiler(command, static=False))
    return next((compiler for compiler in variants if can_build(compiler, target)), None)


def installed_compiler(target: Target, environ: Mapping[str, str]) -> Compiler:
    """The chosen compiler, which is there. Raises KernelBuildError where it is not."""
    compiler = choose_compiler(target, environ)
    if compiler.is_zig:
        try:
            importlib.metadata.version("ziglang")
        except importlib.metadata.PackageNotFoundError:
            raise KernelBuildError(
                "no C++17 compiler with vector extensions was found: install g++ 11 or clang++ 12 or newer "
                f"(Debian, Ubuntu: apt install g++), or pip install {ZIGLANG}"
            ) from None
    return compiler


def wheel_platform(target: Target, compiler: Compiler) -> str:
    """The platform tag of a wheel with libraries from this compiler."""
    if target.system == "linux":
        machine = "aarch64" if target.machine == "arm64" else target.machine
        # A system's compiler links against that system's glibc, whatever its age.
        return f"manylinux_2_17_{machine}" if compiler.is_zig else f"linux_{machine}"
    if target.system == "macosx":
        return f"macosx_11_0_{target.machine}"
    return "win_arm64" if target.machine == "arm64" else "win_amd64"


# --- The build -------------------------------------------------------------------------------------------------------


def kernel_sources(root: Path = ROOT) -> list[Path]:
    """The kernel's .cpp files, relative to `root`."""
    return [path.relative_to(root) for path in sorted((root / KERNEL).glob("*.cpp"))]


def kernel_headers(root: Path = ROOT) -> list[Path]:
    """The kernel's .h files, relative to `root`."""
    return [path.relative_to(root) for path in sorted((root / KERNEL).glob("*.h"))]


def build(
    target: Target,
    compiler: Compiler,
    folder: Path,
    variants: Sequence[Variant] | None = None,
    sanitize: bool = False,
    root: Path = ROOT,
) -> list[Path]:
    """Compile the kernel's variants (default: all of the target) and return their libraries, in order.

    Objects and libraries are kept in `folder` under a digest of all that went into them, and made only where the digest
    is a new one. Each is written beside and then renamed, so that what has its name is whole.
    Raises KernelBuildError; the compiler's own words have gone to standard error by then.
    """
    sources = kernel_sources(root)
    if not sources:
        raise KernelBuildError(f"{root / KERNEL}: the kernel's sources are not there; get the complete source tree")
    wanted = tuple(target.variants if variants is None else variants)
    folder = folder.resolve()
    folder.mkdir(parents=True, exist_ok=True)
    environment = dict(os.environ)
    for name in ("ZIG_GLOBAL_CACHE_DIR", "ZIG_LOCAL_CACHE_DIR"):  # not in the user's home
        environment.setdefault(name, str(folder / "zig"))
    headers = [(root / path).read_bytes() for path in kernel_headers(root)]
    identity = compiler.identity()

    def run(arguments: Sequence[str | Path], output: Path, title: str) -> Path:
        if output.is_file():
            return output
        print(f"{title}: {' '.join(compiler.command)}", flush=True)
        with tempfile.TemporaryDirectory(prefix="new-", dir=folder) as scratch:
            beside = Path(scratch) / output.name
            command = [*compiler.command, *map(str, arguments), "-o", str(beside)]
            # From the root, so that no message or assertion in the library names a folder of this machine.
            done = subprocess.run(
                command, cwd=root, env=environment, stdin=subprocess.DEVNULL, stderr=subprocess.PIPE, errors="replace"
            )
            sys.stderr.write(done.stderr)
            if done.returncode != 0:
                raise KernelBuildError(f"{title}: {' '.join(compiler.command)} failed; its messages are above")
            for old in output.parent.glob(f"{output.name.rpartition('-')[0]}-*{output.suffix}"):
                old.unlink(missing_ok=True)
            beside.replace(output)
        return output

    def compile_object(variant: Variant, source: Path) -> Path:
        flags = compiler.compile_flags(target, variant, sanitize)
        digest = _digest(identity, *flags, str(source), *headers, (root / source).read_bytes())
        output = folder / f"{variant.name}-{source.stem}-{digest}.o"
        return run([*flags, "-c", source], output, f"compiling {source.as_posix()} for {variant.name}")

    def link(variant: Variant, objects: list[Path]) -> Path:
        flags = compiler.link_flags(target, sanitize)
        digest = _digest(identity, *flags, *(path.name for path in objects))
        output = folder / f"{variant.name}-{digest}{SYSTEMS[target.system].suffix}"
        title = f"linking {target.library(variant)}"
        if compiler.is_zig:
            title += " (the first time with zig's C++ library, compiled for it: a minute or two)"
        return run([*objects, *flags], output, title)

    with ThreadPoolExecutor(_processors()) as pool:
        jobs = [[pool.submit(compile_object, variant, source) for source in sources] for variant in wanted]
        try:
            objects = [[job.result() for job in of_variant] for of_variant in jobs]
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
        return [link(variant, made) for variant, made in zip(wanted, objects, strict=True)]


def _digest(*parts: str | bytes) -> str:
    sha = hashlib.sha256()
    for part in parts:
        data = part.encode() if isinstance(part, str) else part
        sha.update(len(data).to_bytes(8, "little"))
        sha.update(data)
    return sha.hexdigest()[:16]


def _processors() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def place(library: Path, destination: Path) -> None:
    """Copy a library to where it is used, by renaming: a process that has the old one loaded keeps it."""
    destination.parent.mkdir(parents=True, exist_ok=True)
    beside = destination.with_name(f"{destination.name}.{os.getpid()}")
    try:
        shutil.copy2(library, beside)
        beside.replace(destination)
    finally:
        beside.unlink(missing_ok=True)


# --- What pip calls (PEP 517 and PEP 660) ----------------------------------------------------------------------------


def build_requirements(environ: Mapping[str, str]) -> list[str]:
    """What the build needs from PyPI beside setuptools: a compiler, where there is none."""
    return [ZIGLANG] if choose_compiler(this_target(), environ).is_zig else []


def get_requires_for_build_wheel(config_settings: dict[str, Any] | None = None) -> list[str]:
    from setuptools import build_meta  # type: ignore[import-untyped]

    try:
        return [*build_meta.get_requires_for_build_wheel(config_settings), *build_requirements(os.environ)]
    except KernelBuildError as error:
        raise SystemExit(f"error: {error}") from None


def get_requires_for_build_editable(config_settings: dict[str, Any] | None = None) -> list[str]:
    return get_requires_for_build_wheel(config_settings)


def __getattr__(name: str) -> Any:
    """The other hooks are setuptools' own, looked up late: building in place needs no setuptools."""
    if name.startswith(("build_", "get_requires_for_", "prepare_metadata_for_")):
        from setuptools import build_meta

        return getattr(build_meta, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


# --- The command line, for developers --------------------------------------------------------------------------------


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(prog="build_kernel.py", description="Build the renderer's kernel in a checkout.")
    target = this_target()
    names = [variant.name for variant in target.variants]
    parser.add_argument("--output", type=Path, default=ROOT / KERNEL, metavar="DIR", help="default: in place")
    parser.add_argument("--variant", action="append", choices=names, help="default: all; may be given several times")
    parser.add_argument("--sanitize", action="store_true", help="with AddressSanitizer and UndefinedBehaviorSanitizer")
    options = parser.parse_args(arguments)
    wanted = [variant for variant in target.variants if variant.name in (options.variant or names)]
    compiler = installed_compiler(target, os.environ)
    folder = ROOT / "build" / ("sanitized" if options.sanitize else "kernel")
    libraries = build(target, compiler, folder, wanted, options.sanitize)
    for variant, library in zip(wanted, libraries, strict=True):
        place(library, options.output / target.library(variant))
        print(options.output / target.library(variant))


if __name__ == "__main__":
    try:
        main()
    except KernelBuildError as error:
        raise SystemExit(f"error: {error}") from None
