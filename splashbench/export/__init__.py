"""Exports: a fitted reconstruction as files that other programs open, a module per format (docs/exports.md).

Every export is a folder with a manifest.json. `splashbench export` calls the functions below, which take what
`splashbench.load` returns:

    from splashbench.export import export_meshes
    export_meshes(splashbench.load("submissions/bowl"), "meshes")
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from splashbench.export.gaussians import export_gaussians
    from splashbench.export.instants import export_times
    from splashbench.export.manifest import MANIFEST, Manifest
    from splashbench.export.mesh import export_meshes
    from splashbench.export.nerfstudio import export_nerfstudio
    from splashbench.export.particles import export_particles
    from splashbench.export.placement import Placement, place
    from splashbench.export.velocity import export_velocity

__all__ = [
    "MANIFEST",
    "Manifest",
    "Placement",
    "export_gaussians",
    "export_meshes",
    "export_nerfstudio",
    "export_particles",
    "export_times",
    "export_velocity",
    "place",
]

#: Module -> the names that are imported from it on demand: Gaussians need torch, meshes do not.
_MODULES = {
    "gaussians": ("export_gaussians",),
    "instants": ("export_times",),
    "manifest": ("MANIFEST", "Manifest"),
    "mesh": ("export_meshes",),
    "nerfstudio": ("export_nerfstudio",),
    "particles": ("export_particles",),
    "placement": ("Placement", "place"),
    "velocity": ("export_velocity",),
}

if not TYPE_CHECKING:  # else mypy would take any name for one of the module's

    def __getattr__(name: str) -> Any:
        for module, names in _MODULES.items():
            if name in names:
                value = getattr(import_module(f"{__name__}.{module}"), name)
                globals()[name] = value
                return value
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
