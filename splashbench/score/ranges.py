"""What a metric's figure can be at all: the least and the most by definition, or far beyond any run.

A result may come from a stranger. A figure outside its range, or one that is not the mean of its own frames, is none
that `splashbench score` wrote (docs/protocol.md, "Results of others").
"""

from __future__ import annotations

import math

from splashbench.score.metrics import METRICS

#: No figure of a run comes near.
MOST = 1e15
# SSIM and its like are means of float64 and may pass their bounds by rounding.
_ROUNDING = 1e-6
_SHARE = (0.0, 1.0)
_RANGES = {
    "ssim": (-1.0, 1.0),
    "ssim_fg": (-1.0, 1.0),
    "lpips": (0.0, 100.0),  # five layers, each at most four times its largest weight
    "spill": (0.0, 1e9),  # of 64 mask pixels or more in the largest image that is read
    "spill_rgb": (0.0, 1e9),
    "jitter_error": _SHARE,  # standard deviations of differences of intensities in [0, 1]
    "miou": _SHARE,
    "delta_e": _SHARE,
    "surface_chamfer": (0.0, 20.0),  # where single distances are clipped
    "sdf_iou": _SHARE,
    "sdf_recall": _SHARE,
    "sdf_precision": _SHARE,
    "velocity_coverage": _SHARE,
}
#: Metrics whose value is the mean over the views of means over frames, and those that are the mean over frames.
MEANS_OF_VIEWS = ("psnr", "dpsnr_bg", "ssim", "ssim_fg", "lpips", "spill", "spill_rgb", "miou")
MEANS_OF_FRAMES = ("sigma_d", "mu_d", "uniformity", "surface_chamfer", "sdf_iou", "sdf_recall", "sdf_precision")


def range_of(name: str, psnr_cap: float) -> tuple[float, float]:
    """Least and greatest value of metric `name`, in its stored unit; `psnr_cap`: of the protocol, dB."""
    if name == "psnr":
        return (0.0, psnr_cap)
    if name == "dpsnr_bg":
        return (-psnr_cap, psnr_cap)
    return _RANGES.get(name, (0.0, MOST))


def range_fault(name: str, value: float | None, psnr_cap: float) -> str:
    """Why `value` is no figure of metric `name`, in words; "" where it may be one. Other names have no range."""
    if value is None or (name not in METRICS and math.isfinite(value)):
        return ""
    least, most = range_of(name, psnr_cap)
    if least - _ROUNDING <= value <= most + _ROUNDING:
        return ""
    return f"is {value:g}, which no run has ({least:g} to {most:g})"


def agree(name: str, first: float, second: float) -> bool:
    """Whether two figures of metric `name` are one: no further apart than half a unit of its last printed decimal.

    Scoring again on another processor or with another numpy gives other last digits.
    """
    return abs(first - second) <= max(0.5 * 10.0 ** -METRICS[name].decimals, 1e-4 * max(abs(first), abs(second)))
