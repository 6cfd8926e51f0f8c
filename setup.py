"""What pyproject.toml cannot say: compiled kernels are built along, and a wheel fits every Python 3 on its platform.

The compiling itself, and why it is done so, is in build_kernel.py.
"""

from __future__ import annotations

import functools
import os
from pathlib import Path

from setuptools import Extension, find_packages, setup  # type: ignore[import-untyped]
from setuptools.command.bdist_wheel import bdist_wheel  # type: ignore[import-untyped]
from setuptools.command.build_ext import build_ext  # type: ignore[import-untyped]
from setuptools.errors import CompileError  # type: ignore[import-untyped]

import build_compilers
import build_kernel
from build_compilers import KernelBuildError

try:
    build_compilers.check_platform()
    KERNELS = build_kernel.kernels()
except KernelBuildError as error:
    raise SystemExit(f"error: {error}") from None


@functools.cache
def compiler() -> build_compilers.Compiler:
    """The compiler of this build, looked for when it is needed: not when pip asks for the metadata."""
    try:
        return build_compilers.installed_compiler(os.environ)
    except KernelBuildError as error:
        raise CompileError(str(error)) from None


#: Folder at the top -> the name it installs under.
FOLDERS = {
    "splashbench": "splashbench",
    "methods": "splashbench_methods",
    "data_manifest": "splashbench_data_manifest",
    "leaderboards": "splashbench_leaderboards",
}


def packages() -> list[str]:
    """Every folder with an __init__.py below FOLDERS, by the name it installs under."""
    return [
        ".".join([name, *below.split(".")] if below else [name])
        for folder, name in FOLDERS.items()
        for below in ["", *sorted(find_packages(folder))]
    ]


def library_name(library: Path) -> str:
    """The name that setuptools knows a library by, such as splashbench.render.kernel.librender_avx2."""
    return ".".join([FOLDERS[library.parts[0]], *library.with_suffix("").parts[1:]])


class BuildKernel(build_ext):
    """Shared libraries, loaded with ctypes: no modules of Python, and not named after one version of it."""

    def get_ext_filename(self, fullname: str) -> str:
        return str(Path(*fullname.split("."))) + ".so"

    def build_extensions(self) -> None:
        folder = Path(self.get_finalized_command("build").build_base) / "kernel"
        try:
            libraries = build_kernel.build(compiler(), folder)
        except KernelBuildError as error:
            raise CompileError(str(error)) from None
        for library, built in libraries.items():
            build_kernel.place(built, Path(self.get_ext_fullpath(library_name(library))))

    def copy_extensions_to_source(self) -> None:
        build_py = self.get_finalized_command("build_py")
        for extension in self.extensions:
            package, _, name = extension.name.rpartition(".")
            built = Path(self.build_lib, self.get_ext_filename(extension.name))
            build_kernel.place(built, Path(build_py.get_package_dir(package), self.get_ext_filename(name)))


class PlatformWheel(bdist_wheel):
    """A wheel for one platform and every Python 3."""

    def get_tag(self) -> tuple[str, str, str]:
        if self.plat_name_supplied and self.plat_name:
            platform = self.plat_name.lower().replace("-", "_").replace(".", "_")
        else:
            platform = compiler().wheel_platform
        return "py3", "none", platform


setup(
    packages=packages(),
    package_dir={name: folder for folder, name in FOLDERS.items()},
    ext_modules=[
        Extension(
            library_name(kernel.library(variant)),
            sources=[path.as_posix() for path in kernel.sources()],
            depends=[path.as_posix() for path in kernel.headers()],
            language="c++",
        )
        for kernel in KERNELS
        for variant in build_compilers.VARIANTS
    ],
    cmdclass={"build_ext": BuildKernel, "bdist_wheel": PlatformWheel},
)
