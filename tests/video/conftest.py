"""A reconstruction that is made up: one ball of liquid on its way, of which every picture and number is known."""

from __future__ import annotations

import threading
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from splashbench.harness.contract import Fitted, Render
from splashbench.harness.runner import run_method
from splashbench.replay import Reconstruction
from splashbench.scene import Camera, Particles, Scene, SignedDistance, VelocityField
from splashbench.submission import Submission

#: The ball's speed along x and its radius, scene units.
SPEED, RADIUS = 0.5, 0.15
SKY = (0.25, 0.5, 0.75)


def ball_center(time: float) -> NDArray[np.float64]:
    """Where the ball is at `time` seconds [3]."""
    return np.array([-0.1 + SPEED * time, 0.3, 0.0])


class Ball(Fitted):
    """A red ball before a sky; half of it is seen through. threads: that rendered it."""

    def __init__(self) -> None:
        self.threads: set[int] = set()
        self.times: list[float] = []

    def render(self, camera: Camera, time: float) -> Render:
        self.threads.add(threading.get_ident())
        self.times.append(time)
        center, depth = camera.project(ball_center(time)[None])
        v, u = np.mgrid[: camera.height, : camera.width] + 0.5
        radius = RADIUS * camera.K[0, 0] / depth[0]
        alpha = np.where((u - center[0, 0]) ** 2 + (v - center[0, 1]) ** 2 < radius**2, 0.75, 0).astype(np.float32)
        rgb = alpha[..., None] * np.array([1, 0, 0]) + (1 - alpha[..., None]) * np.array(SKY)
        return Render(rgb.astype(np.float32), alpha)

    def empty_view(self, camera: Camera) -> NDArray[np.float32]:
        return np.broadcast_to(np.array(SKY, np.float32), (camera.height, camera.width, 3)).copy()

    def surface(self, time: float) -> SignedDistance:
        origin, voxel = np.array([-0.4, 0.0, -0.3]), 0.02
        nodes = origin + voxel * np.stack(np.meshgrid(*map(np.arange, (45, 31, 31)), indexing="ij"), -1)
        distance = np.linalg.norm(nodes - ball_center(time), axis=-1) - RADIUS
        return SignedDistance.of(distance[None] / voxel, origin, voxel)

    def velocity(self, time: float) -> VelocityField:
        values = np.zeros((2, 2, 2, 3), np.float32)
        values[..., 0] = SPEED
        return VelocityField(values, np.full(3, -1.0), np.full(3, 2.0), np.ones((2, 2, 2), bool))

    def particles(self) -> Particles | None:
        return None

    def save(self, directory: Path) -> None:
        raise NotImplementedError


@pytest.fixture(scope="session")
def oracle(balls_directory: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The oracle's submission of the balls: test views without a model; not to be changed."""
    directory = tmp_path_factory.mktemp("submissions") / "oracle"
    run_method("oracle", balls_directory, directory, timing_frames=0)
    return directory


@pytest.fixture(scope="session")
def points(balls_directory: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """hull_points' submission of the balls, with its model; not to be changed."""
    directory = tmp_path_factory.mktemp("submissions") / "points"
    run_method("hull_points", balls_directory, directory, overrides={"points": 300, "cells": 32}, timing_frames=0)
    return directory


@pytest.fixture
def ball(oracle: Path, balls: Scene) -> Reconstruction:
    """The made-up ball in the scene of the balls."""
    return Reconstruction(Submission.open(oracle), Ball(), balls.training(), balls)
