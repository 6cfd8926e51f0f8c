"""Models of the official Deformable-3DGS (ingra14m/Deformable-3D-Gaussians), read and drawn as that code draws them.

It leaves point_cloud/iteration_N/point_cloud.ply, deform/iteration_N/deform.pth and cfg_args. Against deformable_3dgs:

    rotation = normalise(q) + dr, not normalised again: its matrix turns and resizes
    the octaves are those of positions in the export's box, (x - center) scale; so are scales and the near plane
    lenses have one focal length and their principal point in the middle
    time is a photograph's share of the last one's time_id

Networks of both kinds are read: for real scenes, and for synthetic ones (--is_blender), whose time goes through a
network of its own. Models with rigid motions (--is_6dof) are not.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import ClassVar

import numpy as np
import torch
from pydantic import BaseModel, ConfigDict, Field
from torch import Tensor, nn

from splashbench.errors import SplashbenchError
from splashbench.files import read_json, read_model, read_npz, validate_model
from splashbench.files.ply import PointCloud, read_point_cloud
from splashbench.gaussians.dynamic_model import unit_quaternion_matrices
from splashbench.gaussians.mixed_model import MODEL_FILE, load_tables
from splashbench.gaussians.official.checkpoint import fill, read_weights
from splashbench.gaussians.official.model import NEAR, OfficialFitted, OfficialModel, require_finite
from splashbench.gaussians.official.output_folder import TrainingArguments, last_point_cloud
from splashbench.harness.external.importers import Importer
from splashbench.scene import Camera, TrainingScene
from splashbench.scene.export.nerfies import MICROSECONDS
from splashbench.scene.export.records import FACTS, ExportFacts

from .deformation import Deformation
from .model import ROWS, DeformableModel

_DEPTH, _WIDTH = 8, 256
_SYNTHETIC_OCTAVES, _SYNTHETIC_FEATURES = 6, 30


class _NerfiesBox(BaseModel):
    """scene.json: the code's coordinates are (x - center) scale."""

    model_config = ConfigDict(allow_inf_nan=False)
    scale: float = Field(gt=0)
    center: list[float] = Field(min_length=3, max_length=3)


class _NerfiesSplit(BaseModel):
    """dataset.json: ids of all the photographs that the code reads."""

    train_ids: list[str] = Field(min_length=1)
    val_ids: list[str]


class _NerfiesPhotograph(BaseModel):
    """An entry of metadata.json."""

    time_id: int = Field(ge=0)


class _Metadata(BaseModel):
    """metadata.json, by id."""

    photographs: dict[str, _NerfiesPhotograph]


class OfficialDeformable(OfficialModel, DeformableModel):
    """N Gaussians of the official code, in scene units; `synthetic` tells the kind of network."""

    def __init__(self, n: int, sh_degree: int, synthetic: bool) -> None:
        super().__init__(n, sh_degree, 1, 1)
        octaves = {"time_octaves": _SYNTHETIC_OCTAVES, "time_features": _SYNTHETIC_FEATURES} if synthetic else {}
        self.deformation = Deformation(_DEPTH, _WIDTH, **octaves)

    def turned(self, quaternions: Tensor) -> Tensor:
        return unit_quaternion_matrices(quaternions)

    def lens(self, camera: Camera) -> Camera:
        focal = camera.K[0, 0]
        return replace(camera, K=np.array([[focal, 0, camera.width / 2], [0, focal, camera.height / 2], [0, 0, 1]]))


class OfficialDeformable3DGS(Importer):
    """Reads what `train.py -s {scene} -m {out}` leaves in {out}."""

    id: ClassVar[str] = "deformable_3dgs"
    title: ClassVar[str] = "Deformable-3DGS, the official code's models"
    formats: ClassVar[tuple[str, ...]] = ("nerfies",)
    mixed: ClassVar[bool] = True

    def read(self, output: Path, export: Path, scene: TrainingScene) -> OfficialFitted:
        path = last_point_cloud(output)
        network = output / "deform" / path.parent.name / "deform.pth"
        box = read_model(export / "scene.json", _NerfiesBox)
        weights = read_weights(network)
        if any(name.startswith("branch_") for name in weights):
            raise SplashbenchError(f"{network} is of --is_6dof, whose rigid motions are not read; train without it")
        model = _gaussians(read_point_cloud(path), box, synthetic="timenet.0.weight" in weights)
        fill(_slots(model.deformation), weights, network)
        model.clock.copy_(torch.tensor(_clock(export), dtype=torch.float64))
        if TrainingArguments.read(output).flag("white_background"):
            model.background.fill_(1)
        return require_finite(OfficialFitted(model, scene), path)

    def load(self, directory: Path, scene: TrainingScene) -> OfficialFitted:
        path = directory / MODEL_FILE
        tables = read_npz(path, {"rest": 3}, {"deformation.times.0.weight": 2})
        degree = round((tables["rest"].shape[1] + 1) ** 0.5) - 1
        model = OfficialDeformable(0, degree, synthetic=len(tables) > 1)
        load_tables(path, model, ROWS)
        return OfficialFitted(model, scene)


def _gaussians(cloud: PointCloud, box: _NerfiesBox, synthetic: bool) -> OfficialDeformable:
    """The cloud's Gaussians in scene units; the network's weights are still to come."""
    rest = cloud.count("f_rest_")
    degree = {0: 0, 9: 1, 24: 2, 45: 3}.get(rest)
    if degree is None:
        raise SplashbenchError(f"{cloud.path} has {rest} properties f_rest_, not 0, 9, 24 or 45; give the code's file")
    n, unit = len(cloud), 1 / box.scale
    model = OfficialDeformable(n, degree, synthetic)
    tables = {
        "positions": cloud.table("x", "y", "z").astype(np.float64) * unit + box.center,
        "log_scales": cloud.numbered("scale_", 3) + np.log(unit),
        "quaternions": cloud.numbered("rot_", 4),
        "opacity_logits": cloud.table("opacity")[:, 0],
        "constant": cloud.numbered("f_dc_", 3),
        # All of a channel's coefficients come before the next one's.
        "rest": cloud.numbered("f_rest_", rest).reshape(n, 3, -1).transpose(0, 2, 1),
    }
    for name, table in tables.items():
        setattr(model, name, nn.Parameter(torch.from_numpy(np.ascontiguousarray(table, np.float32))))
    model.near.fill_(NEAR * unit)
    model.deformation.center.copy_(torch.tensor(box.center))
    model.deformation.unit.fill_(unit)
    return model


def _slots(network: Deformation) -> dict[str, Tensor]:
    """The network's tensors by the official names."""
    parts = {f"linear.{i}": layer for i, layer in enumerate(network.layers)}
    parts |= {"gaussian_warp": network.shift, "gaussian_rotation": network.turn, "gaussian_scaling": network.growth}
    if isinstance(network.times, nn.Sequential):
        parts |= {"timenet.0": network.times[0], "timenet.2": network.times[2]}
    return {f"{name}.{kind}": getattr(part, kind) for name, part in parts.items() for kind in ("weight", "bias")}


def _clock(export: Path) -> tuple[float, float]:
    """Origin and unit of the code's clock, seconds: at its time 1 is the last of the photographs that it reads."""
    split, path = read_model(export / "dataset.json", _NerfiesSplit), export / "metadata.json"
    photographs = validate_model(path, _Metadata, {"photographs": read_json(path)}).photographs
    missing = [name for name in split.train_ids + split.val_ids if name not in photographs]
    if missing:
        raise SplashbenchError(f"{path} lacks {missing[0]}; export the scene again")
    last = max(photographs[name].time_id for name in split.train_ids + split.val_ids)
    if last == 0:
        raise SplashbenchError(
            f"{path}: all photographs are of one time, by which the code divides; export a recording"
        )
    return read_model(export / FACTS, ExportFacts).time_origin_seconds, last / MICROSECONDS
