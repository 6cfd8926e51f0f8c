"""Models of the official 4D-Scaffold-GS (as a public fork of it has the code), drawn as that code draws them.

It leaves point_cloud/iteration_N with point_cloud.ply, 89 numbers per anchor, and opacity_mlp.pt, cov_mlp.pt,
color_mlp.pt and flow_mlp.pt, which torch.jit traced; and cfg_args. Against scaffold_4d:

    nothing is divided by the eighth scale, velocities reach 1 scene unit per time unit
    time is `time` of the Blender layout times --frame_ratio
    without `--temporal_opacity ours` alpha = rho exp(-(t_k - tau)^2 sigma), without --use_flow nothing moves
    anchors that do not show in the image by themselves, with axes s[0:3], give no Gaussians

Frames with focal lengths leave its angles of view at -1 rad, and footprints are projected with these. It is as if every
Gaussian stood at the one slope -1.3 tan(1/2) in front of a lens of focal length size / (2 tan(1/2)) pixels. Its
models are fitted so, and look wrong in any other way.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor, nn

from splashbench.errors import SplashbenchError
from splashbench.files import read_model
from splashbench.files.ply import PointCloud, read_point_cloud
from splashbench.gaussians.mixed_model import MODEL_FILE, load_tables
from splashbench.gaussians.official.checkpoint import fill, read_weights
from splashbench.gaussians.official.model import OfficialFitted, OfficialModel, require_finite
from splashbench.gaussians.official.output_folder import TrainingArguments, last_point_cloud
from splashbench.harness.external.importers import Importer
from splashbench.render.constants import BLUR_VARIANCE, JACOBIAN_MARGIN
from splashbench.scene import Camera, TrainingScene
from splashbench.scene.export.records import FACTS, ExportFacts

from ..scaffold_gs.model import FEATURES
from .model import (
    MAX_CHILDREN,
    ROWS,
    AnchorInstant,
    AnchorSplats,
    SpacetimeAnchors,
    SpacetimeAnchorSpec,
    stored_children,
)

_HEADS = {"opacity_mlp": "opacity_head", "cov_mlp": "shape_head", "flow_mlp": "flow_head", "color_mlp": "color_head"}
#: Options that change what the networks read; none of them is in the published scripts.
_OTHER_MODELS = ("use_feat_bank", "add_opacity_dist", "add_cov_dist", "add_color_dist", "use_entropy_coding")
_TANGENT = math.tan(0.5)
_SLOPE = 1.3 * _TANGENT
_TILE = 16


class OfficialAnchors(OfficialModel, SpacetimeAnchors):
    """N anchors of the official code, in scene units and its own time."""

    squared: Tensor

    def __init__(self, n: int, variant: SpacetimeAnchorSpec) -> None:
        super().__init__(n, variant)
        self.register_buffer("squared", torch.tensor(False))

    def _fading(self, raw: Tensor, scales: Tensor, since: Tensor) -> tuple[Tensor, Tensor]:
        if not self.squared:
            return super()._fading(raw, scales, since)
        sigma = nn.functional.elu(raw) + 1
        return torch.exp(-(since**2) * sigma), sigma

    def splats(self, state: AnchorInstant, camera: Camera) -> AnchorSplats:
        splats = super().splats(state, camera)
        assert isinstance(splats, AnchorSplats)  # of SpacetimeAnchors, the second base
        children = self.offsets.shape[1]
        shown = in_the_image(self.positions[state.anchors, :3], self.log_scales[state.anchors, :3], camera, self.near)
        splats.opacities = splats.opacities * shown.repeat_interleave(children)
        splats.factors = published_footprints(splats.means, splats.factors, camera)
        return splats


def _published_projection(camera: Camera) -> Tensor:
    """The published Jacobian [2, 3], times depth."""
    fx, fy = camera.width / (2 * _TANGENT), camera.height / (2 * _TANGENT)
    return torch.tensor([[fx, 0, fx * _SLOPE], [0, fy, fy * _SLOPE]], dtype=torch.float32)


def _in_camera(points: Tensor, camera: Camera) -> tuple[Tensor, Tensor]:
    """`points` [N, 3] in the camera's axes, and its rotation [3, 3]."""
    w2c = torch.tensor(camera.w2c, dtype=torch.float32)
    return points @ w2c[:3, :3].T + w2c[:3, 3], w2c[:3, :3]


def published_footprints(means: Tensor, factors: Tensor, camera: Camera) -> Tensor:
    """Factors [N, 3, 3] whose footprints are, projected as they should be, those that the code gives `factors`."""
    local, rotation = _in_camera(means, camera)
    K = torch.tensor(camera.K, dtype=torch.float32)
    size = torch.tensor([camera.width, camera.height], dtype=torch.float32)
    focal, middle, margin = K.diagonal()[:2], K[:2, 2], JACOBIAN_MARGIN * size
    slopes = (local[:, :2] / local[:, 2:]).nan_to_num()
    slopes = torch.minimum(torch.maximum(slopes, (-margin - middle) / focal), (size + margin - middle) / focal)
    # J = diag(f) [I, -slope] / z on our side, and the shortest vectors that it takes to the published projections.
    sides = torch.cat([torch.eye(2).expand(len(means), 2, 2), -slopes[:, :, None]], dim=2)
    published = _published_projection(camera) / focal[:, None]
    across = sides.transpose(1, 2) @ torch.linalg.solve(
        sides @ sides.transpose(1, 2), published.expand(len(means), 2, 3)
    )
    return rotation.T @ across @ rotation @ factors


def in_the_image(positions: Tensor, log_scales: Tensor, camera: Camera, near: Tensor) -> Tensor:
    """bool [N]: ellipsoids at `positions` [N, 3] with axes exp(log_scales) whose square of 3 sigma meets the image."""
    local, rotation = _in_camera(positions, camera)
    flat = _published_projection(camera) @ rotation * torch.exp(log_scales)[:, None] / local[:, 2, None, None]
    blurred = flat @ flat.transpose(1, 2) + BLUR_VARIANCE * torch.eye(2)
    half = (blurred[:, 0, 0] + blurred[:, 1, 1]) / 2
    largest = half + (half**2 - torch.linalg.det(blurred)).clamp(min=0.1).sqrt()
    reach = torch.ceil(3 * largest.sqrt())[:, None]
    K = torch.tensor(camera.K, dtype=torch.float32)
    places = local[:, :2] / local[:, 2:] * K.diagonal()[:2] + K[:2, 2] - 0.5
    tiles = torch.tensor([-(-camera.width // _TILE), -(-camera.height // _TILE)])
    meets = (places - reach < _TILE * tiles) & (places + reach >= 1)
    return (local[:, 2] > near) & meets.all(dim=1)


class OfficialScaffold4D(Importer):
    """Reads what `train.py --eval -s {scene} -m {out} ... --appearance_dim 0` leaves in {out}."""

    id: ClassVar[str] = "scaffold_4d"
    title: ClassVar[str] = "4D-Scaffold-GS, the official code's models"
    formats: ClassVar[tuple[str, ...]] = ("blender",)
    mixed: ClassVar[bool] = True

    def read(self, output: Path, export: Path, scene: TrainingScene) -> OfficialFitted:
        path, arguments = last_point_cloud(output), TrainingArguments.read(output)
        fading = arguments.text("temporal_opacity")
        if arguments.number("appearance_dim") != 0:
            raise SplashbenchError(
                f"{arguments.path}: colours depend on the training photograph; train with --appearance_dim 0"
            )
        for option in _OTHER_MODELS:
            if arguments.flag(option):
                raise SplashbenchError(f"{arguments.path}: models with --{option} are not read; train without it")
        flow = 1.0 if arguments.flag("use_flow") else 0.0
        model = _anchors(read_point_cloud(path), arguments.number("hparam_beta", 4.0), flow)
        model.squared.fill_(fading != "ours")
        for name, attribute in _HEADS.items():
            head = getattr(model, attribute)
            slots = {f"{i}.{kind}": getattr(head[i], kind) for i in (0, 2) for kind in ("weight", "bias")}
            weights = path.with_name(f"{name}.pt")
            fill(slots, read_weights(weights), weights)
        facts, ratio = read_model(export / FACTS, ExportFacts), arguments.number("frame_ratio", 1.0)
        unit = (facts.time_span_seconds or 1.0) / (ratio if ratio > 0 else 1.0)
        model.clock.copy_(torch.tensor([facts.time_origin_seconds, unit], dtype=torch.float64))
        if arguments.flag("white_background"):
            model.background.fill_(1)
        return require_finite(OfficialFitted(model, scene), path)

    def load(self, directory: Path, scene: TrainingScene) -> OfficialFitted:
        path = directory / MODEL_FILE
        model = OfficialAnchors(0, SpacetimeAnchorSpec(stored_children(path)))
        load_tables(path, model, ROWS)
        return OfficialFitted(model, scene)


def _anchors(cloud: PointCloud, beta: float, fastest: float) -> OfficialAnchors:
    """The cloud's anchors; the weights of the heads are still to come."""
    offsets, features = cloud.count("f_offset_"), cloud.count("f_anchor_feat_")
    children = offsets // 4
    if offsets % 4 or not 1 <= children <= MAX_CHILDREN or features != FEATURES:
        raise SplashbenchError(
            f"{cloud.path} has {offsets} properties f_offset_ and {features} f_anchor_feat_, not 4 per Gaussian and "
            f"{FEATURES}; train with the published sizes"
        )
    model = OfficialAnchors(len(cloud), SpacetimeAnchorSpec(children, beta, fastest, base_color=False))
    scales = cloud.numbered("scale_", 8)
    scales[:, 7] = 0  # which the code leaves unused
    tables = {
        "features": cloud.numbered("f_anchor_feat_", FEATURES),
        # All children's x come before their y.
        "offsets": cloud.numbered("f_offset_", offsets).reshape(-1, 4, children).transpose(0, 2, 1),
        "log_scales": scales,
    }
    for name, table in tables.items():
        setattr(model, name, nn.Parameter(torch.from_numpy(np.ascontiguousarray(table))))
    model.positions = torch.from_numpy(cloud.table("x", "y", "z", "t"))
    return model
