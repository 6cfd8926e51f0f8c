"""Gaussians of a reconstruction, in the export's places and with colours for every direction."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from splashbench.errors import SplashbenchError
from splashbench.export.harmonics import Viewpoints, fit_harmonics
from splashbench.export.placement import Placement
from splashbench.gaussians.spherical_harmonics import constant_of
from splashbench.replay import Reconstruction
from splashbench.scene import Gaussians

# No renderer draws what is fainter than one grey level.
_FAINTEST = 1 / 255
# Gaussians are the same ones from wherever they are seen if none moves by more, in shares of their extent.
_SAME_PLACE = 1e-6

#: What a model shows from a place [3]; None where it has no such Gaussians.
Seen = Callable[[NDArray[np.float64]], Gaussians | None]


@dataclass(frozen=True)
class Coloured:
    """Gaussians as they are exported.

    Attributes:
        gaussians: N of them, placed. coefficients: [N, (degree + 1)^2, 3] of their colours, see `fit_harmonics`.
        fixed: whether the colours are those seen from one place alone, as there are other Gaussians from elsewhere.
    """

    gaussians: Gaussians
    coefficients: NDArray[np.float32]
    fixed: bool = False

    def __len__(self) -> int:
        return len(self.gaussians)

    @classmethod
    def plain(cls, gaussians: Gaussians, degree: int, fixed: bool = False) -> Coloured:
        """`gaussians`, placed already, with their colours the same from everywhere."""
        coefficients = np.zeros((len(gaussians), (degree + 1) ** 2, 3), np.float32)
        coefficients[:, 0] = constant_of(torch.as_tensor(gaussians.colors, dtype=torch.float64)).numpy()
        return cls(gaussians, coefficients, fixed)


def coloured(
    reconstruction: Reconstruction, seen: Seen, seen_from: Viewpoints, placement: Placement, degree: int
) -> Coloured | None:
    """What `seen` gives, with colours from all of `seen_from`; None where it gives nothing.

    What is fainter than one grey level is left out. Raises SplashbenchError for Gaussians that are not finite.
    """
    known = seen(reconstruction.eye)
    if known is None:
        return None
    require_finite(known, reconstruction)
    drawn = known.opacities >= _FAINTEST
    kept = placement.gaussians(known.kept(drawn))
    colors = _seen_colors(known, seen, seen_from)
    if colors is None:
        return Coloured.plain(kept, degree, fixed=True)
    if not np.isfinite(colors).all():
        raise _not_finite(reconstruction, "colors")
    places = Viewpoints(placement.points(seen_from.places), seen_from.weights)
    return Coloured(kept, fit_harmonics(kept.means, colors[:, drawn], places, degree))


def require_finite(gaussians: Gaussians, reconstruction: Reconstruction) -> None:
    """Raise SplashbenchError, naming the submission, where an entry of `gaussians` is not finite."""
    for name in ("means", "factors", "opacities", "colors"):
        if not np.isfinite(getattr(gaussians, name)).all():
            raise _not_finite(reconstruction, name)


def _not_finite(reconstruction: Reconstruction, name: str) -> SplashbenchError:
    directory = reconstruction.submission.directory
    return SplashbenchError(
        f"{directory}: Gaussians of method {reconstruction.name} have {name} that are not finite; fit again"
    )


def _seen_colors(known: Gaussians, seen: Seen, seen_from: Viewpoints) -> NDArray[np.float32] | None:
    """Colours [E, N, 3] of the Gaussians `known` from everywhere; None where there are others from elsewhere."""
    reach = _SAME_PLACE * float(np.ptp(known.means, axis=0).max()) if len(known) else 0.0
    colors = np.empty((len(seen_from.places), len(known), 3), np.float32)
    for place, row in zip(seen_from.places, colors):
        view = seen(place)
        if view is None or len(view) != len(known) or not (np.abs(view.means - known.means) <= reach).all():
            return None
        row[:] = view.colors
    return colors
