"""What a method may return: the bounds of pixels, and arrays that cover the timesteps."""

import numpy as np
import pytest

from splashbench.harness.contract import Render
from splashbench.harness.messages import Failure
from splashbench.harness.output_checks import check_geometry, check_particles, checked_render
from splashbench.scene import Camera, Particles, SignedDistance
from splashbench.submission import Status

CAMERA = Camera("0", 6, 4, np.diag([5.0, 5.0, 1.0]), np.eye(4))


def _render(rgb: float = 0.5, alpha: float = 0.5, kind: type = np.float32) -> Render:
    return Render(np.full((4, 6, 3), rgb, kind), np.full((4, 6), alpha, kind))


@pytest.mark.parametrize("value", [-0.5, 0.0, 1.0, 1.5])
def test_values_up_to_half_outside_are_taken(value: float) -> None:
    render = checked_render(_render(rgb=value, alpha=value), CAMERA, "here")
    assert (render.rgb == value).all()
    assert (render.alpha == value).all()


@pytest.mark.parametrize(
    ("render", "status", "reason"),
    [
        (_render(rgb=-0.51), Status.OUT_OF_RANGE, "rgb is float32 from -0.51 to -0.51"),
        (_render(alpha=1.51), Status.OUT_OF_RANGE, "alpha is float32 from 1.51 to 1.51"),
        (_render(rgb=1, alpha=1, kind=np.uint8), Status.OUT_OF_RANGE, "rgb is uint8"),
        (_render(alpha=np.inf), Status.NOT_FINITE, "NaN or infinite"),
        (Render(np.zeros((6, 4, 3)), np.zeros((4, 6))), Status.WRONG_SIZE, r"\(6, 4, 3\)"),
        (Render(np.zeros((4, 6, 3)), np.zeros((4, 6, 1))), Status.WRONG_SIZE, r"alpha \(4, 6, 1\)"),
        ((np.zeros((4, 6, 3)), np.zeros((4, 6))), Status.INCOMPLETE, "returned tuple"),
    ],
)
def test_a_fault_is_a_status_and_names_the_view(render: Render, status: Status, reason: str) -> None:
    with pytest.raises(Failure, match=f"here: .*{reason}") as failure:
        checked_render(render, CAMERA, "here")
    assert failure.value.status == status


def test_arrays_cover_the_timesteps_and_are_finite() -> None:
    positions, active = np.zeros((3, 2, 3)), np.ones((3, 2), bool)
    check_particles(Particles(positions, active), 3)
    with pytest.raises(Failure, match="cover 3 of 4 timesteps"):
        check_particles(Particles(positions, active), 4)
    with pytest.raises(Failure, match="positions has NaN") as failure:
        check_particles(Particles(np.full((3, 2, 3), np.nan), active), 3)
    assert failure.value.status == Status.NOT_FINITE
    with pytest.raises(Failure, match="velocities has NaN"):
        check_particles(Particles(positions, active, np.full((3, 2, 3), np.nan)), 3)
    geometry = SignedDistance.of(np.zeros((3, 4, 4, 4), np.float32), np.zeros(3), 0.1)
    check_geometry(geometry, 3)
    with pytest.raises(Failure, match="covers 3 of 2 timesteps"):
        check_geometry(geometry, 2)
