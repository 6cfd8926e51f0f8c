"""What pyproject.toml cannot say: the renderer's kernel is built along, and a wheel fits every Python 3 on a platform.

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

import build_kernel
from build_kernel import KernelBuildError

try:
    TARGET = build_kernel.this_target()
except KernelBuildError as error:
    raise SystemExit(f"error: {error}") from None


@functools.cache
def compiler() -> build_kernel.Compiler:
    """The compiler of this build, looked for when it is needed: not when pip asks for the metadata."""
    try:
        return build_kernel.installed_compiler(TARGET, os.environ)
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


class BuildKernel(build_ext):
    """A shared library for each variant of the kernel, loaded with ctypes: no module of Python, no name after one."""

    def get_ext_filename(self, fullname: str) -> str:
        return str(Path(*fullname.split("."))) + build_kernel.SYSTEMS[TARGET.system].suffix

    def build_extensions(self) -> None:
        folder = Path(self.get_finalized_command("build").build_base) / "kernel"
        try:
            libraries = build_kernel.build(TARGET, compiler(), folder)
        except KernelBuildError as error:
            raise CompileError(str(error)) from None
        for extension, library in zip(self.extensions, libraries, strict=True):
            build_kernel.place(library, Path(self.get_ext_fullpath(extension.name)))

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
            platform = build_kernel.wheel_platform(TARGET, compiler())
        return "py3", "none", platform


setup(
    packages=packages(),
    package_dir={name: folder for folder, name in FOLDERS.items()},
    ext_modules=[
        Extension(
            ".".join([*build_kernel.KERNEL.parts, f"libsplash_{variant.name}"]),
            sources=[path.as_posix() for path in build_kernel.kernel_sources()],
            depends=[path.as_posix() for path in build_kernel.kernel_headers()],
            language="c++",
        )
        for variant in TARGET.variants
    ],
    cmdclass={"build_ext": BuildKernel, "bdist_wheel": PlatformWheel},
)
