"""A stand-in for gsplat 1.5.3, which refuses what that version refuses and renders with the reference's formulas."""

from __future__ import annotations

import sys
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any

import pytest
import torch

from splashbench.render import cuda


def _project(
    means: torch.Tensor, covars: torch.Tensor, w2c: torch.Tensor, K: torch.Tensor, size: tuple[int, int], blur: float
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Centers [N, 2], image covariances [N, 3] and depths [N], from the upper triangles of covars [N, 3, 3]."""
    i, j = [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]
    upper = covars[:, i, j]
    symmetric = upper[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)
    local = means @ w2c[:3, :3].T + w2c[:3, 3]
    z = local[:, 2]
    focal, middle, size_px = K.diagonal()[:2], K[:2, 2], torch.tensor(size, dtype=means.dtype)
    slopes = local[:, :2] / z[:, None]
    margin = 0.3 * 0.5 * size_px / focal
    clamped = slopes.clamp(-middle / focal - margin, (size_px - middle) / focal + margin)
    J = means.new_zeros((len(means), 2, 3))
    J[:, 0, 0], J[:, 1, 1] = focal[0] / z, focal[1] / z
    J[:, :, 2] = -focal * clamped / z[:, None]
    M = J @ w2c[:3, :3]
    projected = M @ symmetric @ M.transpose(1, 2)
    flat = torch.stack([projected[:, 0, 0] + blur, projected[:, 0, 1], projected[:, 1, 1] + blur], 1)
    return focal * slopes + middle, flat, z


class GsplatStandIn(ModuleType):
    """A module `gsplat`, version 1.5.3. `calls` holds the arguments of each call."""

    def __init__(self, reference: ModuleType) -> None:
        super().__init__("gsplat")
        self.__version__ = "1.5.3"
        self.reference = reference
        self.calls: list[dict[str, Any]] = []

    def rasterization(
        self,
        means: torch.Tensor,
        quats: torch.Tensor,
        scales: torch.Tensor,
        opacities: torch.Tensor,
        colors: torch.Tensor,
        viewmats: torch.Tensor,
        Ks: torch.Tensor,
        width: int,
        height: int,
        near_plane: float = 0.01,
        far_plane: float = 1e10,
        radius_clip: float = 0.0,
        eps2d: float = 0.3,
        sh_degree: int | None = None,
        packed: bool = True,
        tile_size: int = 16,
        backgrounds: torch.Tensor | None = None,
        render_mode: str = "RGB",
        sparse_grad: bool = False,
        absgrad: bool = False,
        rasterize_mode: str = "classic",
        channel_chunk: int = 32,
        distributed: bool = False,
        camera_model: str = "pinhole",
        segmented: bool = False,
        covars: torch.Tensor | None = None,
        with_ut: bool = False,
        with_eval3d: bool = False,
        radial_coeffs: torch.Tensor | None = None,
        tangential_coeffs: torch.Tensor | None = None,
        thin_prism_coeffs: torch.Tensor | None = None,
        ftheta_coeffs: Any = None,
        rolling_shutter: Any = None,
        viewmats_rs: torch.Tensor | None = None,
    ) -> tuple[torch.Tensor, torch.Tensor, dict]:
        self.calls.append({name: value for name, value in locals().items() if name != "self"})
        n, cameras = len(means), len(viewmats)
        assert n > 0, "gsplat's projection divides by the number of Gaussians: the process would be killed"
        assert means.shape == (n, 3)
        assert covars is not None
        assert covars.shape == (n, 3, 3)
        assert opacities.shape == (n,)
        assert viewmats.shape == (cameras, 4, 4)
        assert Ks.shape == (cameras, 3, 3)
        assert colors.shape[:-1] in ((n,), (cameras, n))
        assert 1 <= colors.shape[-1] <= 513
        assert backgrounds is None or backgrounds.shape == (cameras, colors.shape[-1])
        assert {t.dtype for t in (means, covars, opacities, colors, viewmats, Ks)} == {torch.float32}
        assert backgrounds is None or (backgrounds.dtype == torch.float32 and not backgrounds.requires_grad)
        assert render_mode in ("RGB", "D", "RGB+D")
        images, alphas = [], []
        for c in range(cameras):
            own = colors if colors.ndim == 2 else colors[c]
            behind = None if backgrounds is None else backgrounds[c].double()
            projected = _project(
                means.double(), covars.double(), viewmats[c].double(), Ks[c].double(), (width, height), eps2d
            )
            centers, image_covariances, depths = projected
            drawn = (depths >= near_plane) & (depths <= far_plane) & (opacities >= 1 / 255)
            ids = torch.nonzero(drawn)[:, 0]
            # gsplat sorts by the float32 depth, so that equal ones keep their order.
            ids = ids[torch.argsort(depths[ids].float(), stable=True)]
            features = {
                "RGB": own.double(),
                "D": depths[:, None],
                "RGB+D": torch.cat([own.double(), depths[:, None]], 1),
            }[render_mode]
            whole = self.reference.Tile(slice(0, height), slice(0, width), ids)
            _, alpha = self.reference.alphas_in(whole, centers[ids], image_covariances[ids], opacities[ids].double())
            sums, left = self.reference.blend(alpha, features[ids])
            if behind is not None and render_mode != "D":
                behind = torch.cat([behind, behind.new_zeros(sums.shape[1] - len(behind))])
                sums = sums + left[:, None] * behind
            images.append(sums.reshape(height, width, -1).float())
            alphas.append((1 - left).reshape(height, width, 1).float())
        return torch.stack(images), torch.stack(alphas), {}


def install(monkeypatch: pytest.MonkeyPatch, module: ModuleType) -> None:
    """Make `import gsplat` give `module`, its kernels compiled, and let the CPU pass for a CUDA device."""
    monkeypatch.setitem(sys.modules, "gsplat", module)
    kernels = ModuleType("gsplat.csrc")
    kernels.__spec__ = ModuleSpec("gsplat.csrc", None)
    monkeypatch.setitem(sys.modules, "gsplat.csrc", kernels)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(cuda, "DEVICE", "cpu")
