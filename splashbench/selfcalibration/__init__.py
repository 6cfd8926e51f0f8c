"""Self-calibration: clocks, cameras and exposures that are other than a scene says, found in its own footage."""

from __future__ import annotations

from .scene import CalibratedScene, SelfCalibration, self_calibration
from .unmasked import hardly_masked
from .writing import write_calibrated

__all__ = ["CalibratedScene", "SelfCalibration", "hardly_masked", "self_calibration", "write_calibrated"]
