"""A method that knows the balls: exact surface, velocity, particles and Gaussians. Given to `run` as FILE.py:CLASS."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from splashbench.harness.contract import Fitted, Method, MethodConfig, Render, Run
from splashbench.render import rasterize_arrays
from splashbench.scene import Camera, Gaussians, Particles, SignedDistance, TrainingScene, VelocityField
from splashbench.synth.balls import _RADII, _VELOCITIES, GRAVITY, ball_centers, truth_particles

ORIGIN, VOXEL, SHAPE = np.array([-0.36, -0.06, -0.3]), 0.02, (34, 44, 31)
SKY = np.array([0.75, 0.6, 0.25], np.float32)
#: Colours change by so much from one side to the other.
SHEEN = 0.1
#: Before, there is no liquid.
FIRST = 0.01
PER_BALL = 60
FAINT = 7  # of each ball's Gaussians


def exact_velocity(points: NDArray, time: float) -> NDArray[np.float64]:
    """Velocity [N, 3] of the ball that each of `points` [N, 3] is nearest to."""
    distances = np.linalg.norm(points[:, None] - ball_centers(time), axis=-1) - _RADII
    return _VELOCITIES[distances.argmin(axis=1)] - [0, GRAVITY * time, 0]


def nodes() -> NDArray[np.float64]:
    """Places [nx, ny, nz, 3] of the grid's nodes."""
    return ORIGIN + VOXEL * np.stack(np.meshgrid(*map(np.arange, SHAPE), indexing="ij"), axis=-1)


class ExactBalls(Fitted):
    """The balls themselves, over a floor of Gaussians that lets some of the sky through."""

    def __init__(self, times: NDArray[np.float64]) -> None:
        self.times = times

    def render(self, camera: Camera, time: float) -> Render:
        liquid, floor = self.gaussians(time, camera.center), self.static_gaussians(camera.center)
        parts = [
            np.concatenate([getattr(liquid, name), getattr(floor, name)])
            for name in ("means", "factors", "opacities", "colors")
        ]
        rgb, _ = rasterize_arrays(*parts, camera, background=SKY)
        _, alpha = rasterize_arrays(liquid.means, liquid.factors, liquid.opacities, None, camera)
        return Render(np.clip(rgb, 0, 1), alpha)

    def empty_view(self, camera: Camera) -> NDArray[np.float32]:
        floor = self.static_gaussians(camera.center)
        view, _ = rasterize_arrays(floor.means, floor.factors, floor.opacities, floor.colors, camera, background=SKY)
        return np.asarray(np.clip(view, 0, 1), np.float32)

    def gaussians(self, time: float, eye: NDArray) -> Gaussians:
        if time < FIRST:
            return Gaussians.none()
        rng = np.random.default_rng(5)
        means = truth_particles(np.array([time]), rng, PER_BALL).positions[0]
        turns = np.linalg.qr(rng.normal(size=(len(means), 3, 3)))[0]
        factors = turns * [0.03, 0.02, 0.0]  # without any thickness
        opacities = np.tile(np.linspace(0.2, 1.0, PER_BALL), 3)
        opacities[FAINT::PER_BALL] = 0.001
        tints = np.repeat([[0.2, 0.3, 0.8], [0.3, 0.5, 0.7], [0.2, 0.2, 0.6]], PER_BALL, axis=0)
        return Gaussians(means, factors, opacities, tints + SHEEN * _directions(means, eye))

    def static_gaussians(self, eye: NDArray) -> Gaussians:
        x, z = (grid.ravel() for grid in np.meshgrid(np.linspace(-1, 1, 20), np.linspace(-1, 1, 20)))
        means = np.stack([x, 0 * x, z], axis=1)
        factors = np.tile(np.diag([0.06, 0.002, 0.06]), (len(means), 1, 1))
        tints = np.stack([0.4 + 0.2 * x, 0 * x + 0.4, 0.4 + 0.2 * z], axis=1)
        return Gaussians(means, factors, np.full(len(means), 0.8), tints + SHEEN * _directions(means, eye))

    def particles(self) -> Particles:
        return truth_particles(self.times, np.random.default_rng(5), PER_BALL)

    def surface(self, time: float) -> SignedDistance:
        distances = np.linalg.norm(nodes()[..., None, :] - ball_centers(time), axis=-1) - _RADII
        phi = distances.min(axis=-1) if time >= FIRST else np.ones(SHAPE)
        return SignedDistance.of(phi[None] / VOXEL, ORIGIN, VOXEL)

    def signed_distance(self) -> SignedDistance:
        parts = [self.surface(float(time)).phi for time in self.times]
        return SignedDistance(np.concatenate(parts), ORIGIN, VOXEL)

    def velocity(self, time: float) -> VelocityField:
        values = exact_velocity(nodes().reshape(-1, 3), time).reshape(*SHAPE, 3)
        return VelocityField(values, ORIGIN, np.full(3, VOXEL), self.surface(time).phi[0] < 0)

    def save(self, directory: Path) -> None:
        np.save(directory / "times.npy", self.times)


def _directions(means: NDArray, eye: NDArray) -> NDArray[np.float64]:
    arms = means - eye
    return np.asarray(arms / np.linalg.norm(arms, axis=1, keepdims=True))


class Exact(Method):
    """Fits nothing."""

    id, title, Config = "exact", "the balls themselves", MethodConfig

    def fit(self, scene: TrainingScene, config: MethodConfig, run: Run) -> Fitted:
        return ExactBalls(scene.times)

    def load(self, directory: Path, scene: TrainingScene) -> Fitted:
        return ExactBalls(np.load(directory / "times.npy"))
