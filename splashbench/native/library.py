"""Loads compiled kernels: picks the library for this processor, checks its version, declares its functions to ctypes.

The build makes a library of each kernel for each kind of processor, lib<kernel>_<variant>.so beside the C++ sources.
The best one for this processor is loaded. SPLASHBENCH_SIMD=<variant> asks for another one. SPLASHBENCH_KERNEL=<path>
asks for a library built elsewhere, or for a folder of such libraries. Variants round differently in the last digits,
so a run's record names the one it used.
"""

from __future__ import annotations

import ctypes
import os
from collections.abc import Mapping
from ctypes import c_char_p, c_int32
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from splashbench.errors import SplashbenchError

# SplashStatus of abi.h.
DONE, NOT_FINITE, OUT_OF_MEMORY, TOO_LARGE = range(4)

PLAIN_VARIANT = "baseline"  # runs on every processor, and knows which of the others this one runs
_REBUILD = "install splashbench again (`pip install -e .` in a checkout)"

Signature = tuple[Any, tuple[Any, ...]]
"""What a function returns, and what it takes; ctypes' types."""

# Of abi.h; every kernel has them.
_SHARED: dict[str, Signature] = {
    "splash_kernel": (c_char_p, ()),
    "splash_abi_version": (c_int32, ()),
    "splash_variant": (c_char_p, ()),
    "splash_best_variant": (c_char_p, ()),
    "splash_runs": (c_int32, (c_char_p,)),
}


@dataclass(frozen=True)
class CompiledKernel:
    """A kernel's libraries and their C interface.

    name: that of the folder above the sources. folder: the sources', where the libraries are. abi_version: that of the
    interface which `functions` declares. Every method raises SplashbenchError where a library is missing or unfit.
    """

    name: str
    folder: Path
    abi_version: int
    functions: Mapping[str, Signature]

    @cached_property
    def library(self) -> ctypes.CDLL:
        """The library that this process uses."""
        elsewhere = Path(os.environ.get("SPLASHBENCH_KERNEL") or self.folder)
        if not elsewhere.is_dir():
            library = self._load(elsewhere)
            if library is not None:
                return library
            elsewhere = self.folder  # that file holds another kernel
        variant = os.environ.get("SPLASHBENCH_SIMD", "")
        if variant:
            return self.open_variant(variant, elsewhere)
        best = self._plain.splash_best_variant().decode()
        return self.open_variant(best if best in self.built_variants(elsewhere) else PLAIN_VARIANT, elsewhere)

    @property
    def variant(self) -> str:
        """The name of the variant in use."""
        return str(self.library.splash_variant().decode())

    def built_variants(self, folder: Path | None = None) -> list[str]:
        """The variants in `folder` (default: in this installation), such as ["avx2", "baseline"]."""
        prefix = f"lib{self.name}_"
        return sorted(path.stem.removeprefix(prefix) for path in (folder or self.folder).glob(f"{prefix}*.so"))

    def runs(self, variant: str) -> bool:
        """Whether this processor runs a variant."""
        return bool(self._plain.splash_runs(variant.encode()))

    def open_variant(self, variant: str, folder: Path | None = None) -> ctypes.CDLL:
        """The library of one variant, where this processor runs it."""
        path = self._path(variant, folder or self.folder)
        if not self.runs(variant):
            raise SplashbenchError(f"{path}: this processor does not run it; unset SPLASHBENCH_SIMD")
        return self._open(path)

    @cached_property
    def _plain(self) -> ctypes.CDLL:
        return self._open(self._path(PLAIN_VARIANT, self.folder))

    def _path(self, variant: str, folder: Path) -> Path:
        path = folder / f"lib{self.name}_{variant}.so"
        if not path.exists():
            variants = ", ".join(self.built_variants(folder)) or "none"
            raise SplashbenchError(f"{path}: there is no such kernel (built: {variants}); {_REBUILD}")
        return path

    def _open(self, path: Path) -> ctypes.CDLL:
        library = self._load(path)
        if library is None:
            raise SplashbenchError(f"{path}: holds another kernel than {self.name}; {_REBUILD}")
        return library

    def _load(self, path: Path) -> ctypes.CDLL | None:
        """The library at `path` with its functions declared; None where it holds another kernel."""
        try:
            library = ctypes.CDLL(os.fspath(path))
        except OSError as error:
            raise SplashbenchError(f"{path}: cannot load the kernel {self.name} ({error}); {_REBUILD}") from None
        try:
            _declare(library, _SHARED)
            name, version = library.splash_kernel().decode(), library.splash_abi_version()
        except AttributeError:
            name, version = self.name, None
        if name != self.name:
            return None
        if version != self.abi_version:
            raise SplashbenchError(
                f"{path}: the kernel {self.name} is of version {version}, this code needs {self.abi_version}; "
                f"{_REBUILD}"
            )
        _declare(library, self.functions)
        return library


def _declare(library: ctypes.CDLL, functions: Mapping[str, Signature]) -> None:
    for name, (result, arguments) in functions.items():
        function = getattr(library, name)
        function.restype, function.argtypes = result, arguments
