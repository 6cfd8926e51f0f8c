"""Builds the compiled kernels, and has the hooks that pip calls.

A kernel is a folder called `kernel` with C++ sources, in a room of splashbench or in a method. With the sources of
splashbench/native it becomes one shared library for each kind of processor, beside its sources. A new one needs no
entry anywhere: `kernels` finds it. build_compilers.py has the flags and chooses the compiler.

pip, in an environment of its own, asks this module what the build needs and has setuptools run setup.py, which comes
back here for the compiling. In a checkout, `python build_kernel.py` builds in place; `--help` says what else it can do.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from build_compilers import (
    VARIANTS,
    ZIGLANG,
    Compiler,
    KernelBuildError,
    KernelVariant,
    check_platform,
    choose_compiler,
    installed_compiler,
)

ROOT = Path(__file__).resolve().parent
NATIVE = Path("splashbench") / "native"  # what all kernels share
KERNELS = ("splashbench/*/kernel", "methods/*/kernel")


# --- The kernels -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Kernel:
    """C++ sources that make one library; `folder` is relative to the root of the source tree."""

    folder: Path

    @property
    def name(self) -> str:
        """The folder that holds the kernel: that of a room or of a method."""
        return self.folder.parent.name

    def library(self, variant: KernelVariant) -> Path:
        """Where the library belongs in the source tree; splashbench/native/library.py looks for it there."""
        return self.folder / f"lib{self.name}_{variant.name}.so"

    def sources(self, root: Path = ROOT) -> list[Path]:
        """The .cpp files that are linked, relative to `root`: the kernel's own and the shared ones."""
        return [*_files(root, self.folder, "*.cpp"), *_files(root, NATIVE, "*.cpp")]

    def headers(self, root: Path = ROOT) -> list[Path]:
        """The .h files that its sources may include, relative to `root`."""
        return headers_for(self.folder, root)


def headers_for(folder: Path, root: Path = ROOT) -> list[Path]:
    """The .h files that sources in `folder` may include: those beside them and the shared ones."""
    return [path for place in dict.fromkeys((folder, NATIVE)) for path in _files(root, place, "*.h")]


def _files(root: Path, folder: Path, pattern: str) -> list[Path]:
    return [path.relative_to(root) for path in sorted((root / folder).glob(pattern))]


def kernels(root: Path = ROOT) -> list[Kernel]:
    """Every kernel of the source tree. Raises KernelBuildError where there is none, or two have the same name."""
    folders = {path.parent for pattern in KERNELS for path in root.glob(f"{pattern}/*.cpp")}
    in_tree = [Kernel(folder.relative_to(root)) for folder in sorted(folders)]
    if not in_tree:
        raise KernelBuildError(f"{root}: the kernels' sources are not there; get the complete source tree")
    by_name: dict[str, Kernel] = {}
    for kernel in in_tree:
        other = by_name.setdefault(kernel.name, kernel)
        if other is not kernel:
            raise KernelBuildError(f"{kernel.folder} and {other.folder} make the same library; rename one's folder")
    return in_tree


# --- The build -------------------------------------------------------------------------------------------------------


def build(
    compiler: Compiler,
    folder: Path,
    variants: Sequence[KernelVariant] = VARIANTS,
    sanitize: bool = False,
    root: Path = ROOT,
) -> dict[Path, Path]:
    """Compile every kernel for each variant: {the library's place in the source tree: the file that was built}.

    Objects and libraries are kept in `folder` under a digest of all that went into them, and made only where the digest
    is a new one. Each is written beside and then renamed, so that what has its name is complete.
    Raises KernelBuildError; the compiler's own words have gone to standard error by then.
    """
    folder = folder.resolve()
    folder.mkdir(parents=True, exist_ok=True)
    workshop = _Workshop(compiler, folder, sanitize, root)
    libraries = {kernel.library(variant): (kernel, variant) for kernel in kernels(root) for variant in variants}
    objects: dict[tuple[Path, KernelVariant], Future[Path]] = {}  # those of shared sources serve several libraries
    with ThreadPoolExecutor(len(os.sched_getaffinity(0))) as pool:
        for kernel, variant in libraries.values():
            for source in kernel.sources(root):
                if (source, variant) not in objects:
                    objects[source, variant] = pool.submit(workshop.compile, source, variant)
        try:
            for job in objects.values():
                job.result()
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
    return {
        library: workshop.link(library, [objects[source, variant].result() for source in kernel.sources(root)])
        for library, (kernel, variant) in libraries.items()
    }


class _Workshop:
    """Runs the compiler from the root of the source tree, and keeps what it makes in a folder."""

    def __init__(self, compiler: Compiler, folder: Path, sanitize: bool, root: Path) -> None:
        self._compiler, self._folder, self._sanitize, self._root = compiler, folder, sanitize, root
        self._identity = compiler.identity()
        self._environment = dict(os.environ)
        for name in ("ZIG_GLOBAL_CACHE_DIR", "ZIG_LOCAL_CACHE_DIR"):  # not in the user's home
            self._environment.setdefault(name, str(folder / "zig"))

    def compile(self, source: Path, variant: KernelVariant) -> Path:
        flags = self._compiler.compile_flags(variant, self._sanitize, source)
        inputs = (*headers_for(source.parent, self._root), source)
        contents = [(self._root / path).read_bytes() for path in inputs]
        digest = _digest(self._identity, *flags, str(source), *contents)
        output = self._folder / f"{variant.name}-{'.'.join(source.with_suffix('').parts)}-{digest}.o"
        return self._run([*flags, "-c", source], output, f"compiling {source.as_posix()} for {variant.name}")

    def link(self, library: Path, objects: Sequence[Path]) -> Path:
        flags = self._compiler.link_flags(self._sanitize)
        digest = _digest(self._identity, *flags, *(path.name for path in objects))
        title = f"linking {library.name}"
        if self._compiler.is_zig:
            title += " (the first time with zig's C++ library, compiled for it: a minute or two)"
        return self._run([*objects, *flags], self._folder / f"{library.stem}-{digest}.so", title)

    def _run(self, arguments: Sequence[str | Path], output: Path, title: str) -> Path:
        if output.is_file():
            return output
        command = [*self._compiler.command, *map(str, arguments)]
        print(f"{title}: {' '.join(self._compiler.command)}", flush=True)
        with tempfile.TemporaryDirectory(prefix="new-", dir=self._folder) as scratch:
            beside = Path(scratch) / output.name
            # From the root, so that no message or assertion in the library names a folder of this machine.
            outcome = subprocess.run(
                [*command, "-o", str(beside)],
                cwd=self._root,
                env=self._environment,
                stdin=subprocess.DEVNULL,
                stderr=subprocess.PIPE,
                text=True,
                errors="replace",
            )
            sys.stderr.write(outcome.stderr)
            if outcome.returncode != 0:
                raise KernelBuildError(f"{title}: {' '.join(self._compiler.command)} failed; its messages are above")
            for outdated in output.parent.glob(f"{output.name.rpartition('-')[0]}-*{output.suffix}"):
                outdated.unlink(missing_ok=True)
            beside.replace(output)
        return output


def _digest(*parts: str | bytes) -> str:
    sha = hashlib.sha256()
    for part in parts:
        data = part.encode() if isinstance(part, str) else part
        sha.update(len(data).to_bytes(8, "little"))
        sha.update(data)
    return sha.hexdigest()[:16]


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
    check_platform()
    return [ZIGLANG] if choose_compiler(environ).is_zig else []


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
    parser = argparse.ArgumentParser(prog="build_kernel.py", description="Build the compiled kernels in a checkout.")
    names = [variant.name for variant in VARIANTS]
    parser.add_argument("--output", type=Path, metavar="DIR", help="a folder for the libraries; default: in place")
    parser.add_argument("--variant", action="append", choices=names, help="default: all; may be given several times")
    parser.add_argument("--sanitize", action="store_true", help="with AddressSanitizer and UndefinedBehaviorSanitizer")
    options = parser.parse_args(arguments)
    check_platform()
    variants = [variant for variant in VARIANTS if variant.name in (options.variant or names)]
    folder = ROOT / "build" / ("sanitized" if options.sanitize else "kernel")
    for library, built in build(installed_compiler(os.environ), folder, variants, options.sanitize).items():
        destination = ROOT / library if options.output is None else options.output / library.name
        place(built, destination)
        print(destination)


if __name__ == "__main__":
    try:
        main()
    except KernelBuildError as error:
        raise SystemExit(f"error: {error}") from None
