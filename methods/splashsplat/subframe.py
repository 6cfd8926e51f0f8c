"""The liquid at any time (paper, supplement, "Sub-frame decoding").

Between frames t and t + 1 every carrier of frame t is advected by the fraction of the step with u_t, without
correction or resampling, and phi is interpolated linearly between the two observations. What was learned stays as it
is.
"""

from __future__ import annotations

import numpy as np
import torch
from splashbench_methods.splashsplat.decoder import CarrierState
from splashbench_methods.splashsplat.model import PHI_STEPS_PER_VOXEL, Liquid
from splashbench_methods.splashsplat.transport import forecast
from torch import Tensor

from splashbench.observe.kernels import sample

# Times nearer to a frame than this fraction of the step are that frame: JSON and the harness round seconds.
_SAME_FRAME = 1e-4


def locate(times: np.ndarray, time: float) -> tuple[int, float]:
    """Frame t and fraction in [0, 1) of the step to t + 1 at which `time` lies, clamped to the sequence."""
    times = np.asarray(times, dtype=np.float64)
    if len(times) == 1 or time <= times[0]:
        return 0, 0.0
    if time >= times[-1]:
        return len(times) - 1, 0.0
    t = int(np.searchsorted(times, time, side="right")) - 1
    fraction = float((time - times[t]) / (times[t + 1] - times[t]))
    if fraction < _SAME_FRAME:
        return t, 0.0
    if fraction > 1 - _SAME_FRAME:
        return t + 1, 0.0
    return t, fraction


def state_at(liquid: Liquid, time: float) -> tuple[Tensor, CarrierState]:
    """Carriers at `time` (seconds): their numbers, int64 [n], and the decoder's input."""
    t, fraction = locate(liquid.times, time)
    rows = liquid.carriers.rows(t)
    positions, deformation = liquid.carriers.positions[rows], liquid.carriers.deformation[rows]
    phi = liquid.carriers.phi[rows]
    if fraction > 0 and len(positions):
        control = liquid.velocities[t].astype(np.float32)
        positions, deformation = forecast(control, liquid.factor, positions, deformation, fraction)
        here, there = (sample(liquid.phi[frame], positions) / PHI_STEPS_PER_VOXEL for frame in (t, t + 1))
        phi = ((1 - fraction) * here + fraction * there).astype(np.float32)
    scene_positions = torch.from_numpy(liquid.grid.to_scene(positions).astype(np.float32))
    state = CarrierState(scene_positions, torch.from_numpy(deformation), torch.from_numpy(phi))
    return torch.from_numpy(liquid.carriers.ids[rows].astype(np.int64)), state
