"""The registry of metrics: what each figure is called, its unit, and whether higher or lower is better.

The names are the keys of a result's `metrics` and the columns of the leaderboard.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Better = Literal["higher", "lower"]


@dataclass(frozen=True)
class Metric:
    """One figure of a result.

    Attributes:
        name: key in JSON and column in CSV.
        title: for tables and charts.
        unit: of the stored value; "" for a pure number.
        better: direction of better, or None where neither is.
        decimals: printed in CSV and tables; results keep full precision.
        source: where the definition comes from.
        group: "image", "particles", "truth" (against true particles; all computed here) or "cost" (measured by the
            harness).
        version: of the implementation; raised when a change alters values.
    """

    name: str
    title: str
    unit: str
    better: Better | None
    decimals: int
    source: str
    group: Literal["image", "particles", "truth", "cost"]
    version: int = 1

    @property
    def filtered(self) -> bool:
        """Whether a mixed method's figure covers only those primitives that the silhouettes allow to be liquid.

        The filter is no part of the method (observe/consistency.py), so tables and charts mark such figures.
        """
        return self.group in ("particles", "truth") or self.name in ("spill", "miou", "particles_per_frame")


_PAPER = "paper, Metrics"
_SUPPLEMENT = "paper, supplement, Evaluation Protocol"
_HERE = "protocol v1"

METRICS: dict[str, Metric] = {
    metric.name: metric
    for metric in (
        Metric("psnr", "PSNR", "dB", "higher", 2, _PAPER, "image"),
        Metric("dpsnr_bg", "PSNR over background", "dB", "higher", 2, _HERE, "image"),
        Metric("ssim", "SSIM", "", "higher", 4, _PAPER, "image"),
        Metric("ssim_fg", "SSIM foreground", "", "higher", 4, _HERE, "image"),
        Metric("lpips", "LPIPS", "", "lower", 4, _PAPER, "image"),
        Metric("spill", "Spill", "", "lower", 4, _HERE, "image"),
        Metric("spill_rgb", "Spill RGB", "", "lower", 4, _HERE, "image"),
        Metric("jitter_error", "Jitter error", "", "lower", 4, _PAPER, "image"),
        Metric("sigma_d", "σ_D", "", "lower", 1, _SUPPLEMENT, "particles"),
        Metric("mu_d", "μ_D", "", None, 1, _SUPPLEMENT, "particles"),
        Metric("uniformity", "Uniformity index", "", "lower", 3, _HERE, "particles"),
        Metric("delta_e", "ΔE", "", "lower", 3, _HERE, "particles"),
        Metric("miou", "mIoU@0.5", "", "higher", 4, "paper, Ablation Study", "image"),
        Metric("fit_seconds", "Fit time", "s", "lower", 1, _HERE, "cost"),
        Metric("render_fps", "FPS", "1/s", "higher", 1, _HERE, "cost"),
        Metric("peak_memory_bytes", "Peak memory", "B", "lower", 0, _HERE, "cost"),
        Metric("peak_device_memory_bytes", "Peak device memory", "B", "lower", 0, _HERE, "cost"),
        Metric("storage_bytes", "Storage", "B", "lower", 0, _HERE, "cost"),
        Metric("dynamic_bytes", "Dynamic storage", "B", "lower", 0, _HERE, "cost"),
        Metric("primitives_per_frame", "Primitives per frame", "", None, 0, _HERE, "cost"),
        Metric("particles_per_frame", "Particles per frame", "", None, 0, _HERE, "cost"),
        Metric("surface_chamfer", "Chamfer", "voxels", "lower", 3, _HERE, "truth"),
        Metric("sdf_iou", "Volume IoU", "", "higher", 4, _HERE, "truth"),
        Metric("sdf_recall", "Volume recall", "", "higher", 4, _HERE, "truth"),
        Metric("sdf_precision", "Volume precision", "", "higher", 4, _HERE, "truth"),
        Metric("velocity_epe", "Velocity EPE", "voxels", "lower", 3, _HERE, "truth"),
        Metric("velocity_epe_relative", "Relative EPE", "", "lower", 3, _HERE, "truth"),
        Metric("airborne_epe_relative", "Airborne EPE", "", "lower", 3, _HERE, "truth"),
        Metric("velocity_coverage", "EPE coverage", "", "higher", 3, _HERE, "truth"),
    )
}

#: The figures against true particles, which synthetic scenes alone have.
TRUTH_METRICS = tuple(name for name, metric in METRICS.items() if metric.group == "truth")
