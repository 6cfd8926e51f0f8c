"""hull_points: points of the visual hull, coloured from the training views. The simplest method that is one."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar

import numpy as np

from splashbench import Camera, Fitted, Method, MethodConfig, Particles, Render, Run, TrainingScene
from splashbench.observe import signed_distance_fields
from splashbench.render import rasterize_arrays


class HullPointsSettings(MethodConfig):
    presets: ClassVar[dict] = {"best": {}, "quick": {"points": 2000}}  # the first one is the default
    capacity: ClassVar[dict] = {"points": (500, 2000, 8000, 32000, 128000), "cells": (32, 48, 64, 96, 128)}
    points: int = 8000  # per frame
    cells: int = 64  # of the hull's grid, along its longest side


class HullPoints(Method):
    id = "hull_points"
    title = "points of the visual hull, coloured from the training views"
    version = "2"  # since hulls go on past the sides of images
    Config = HullPointsSettings

    def fit(self, scene: TrainingScene, config: HullPointsSettings, run: Run) -> Model:
        rng = np.random.default_rng(run.seed)
        fields = signed_distance_fields(scene, cells_longest_axis=config.cells)
        positions = np.zeros((scene.n_frames, config.points, 3), np.float32)
        active = np.zeros((scene.n_frames, config.points), bool)
        colors = np.full((scene.n_frames, config.points, 3), 0.5, np.float32)
        for t in range(scene.n_frames):
            run.progress(t / scene.n_frames, "sampling the hull")
            inside = np.argwhere(fields.phi[t] < 0)
            if len(inside) == 0:
                continue
            cells = inside[rng.integers(0, len(inside), config.points)]
            positions[t] = fields.origin + (cells + rng.uniform(-0.5, 0.5, cells.shape)) * fields.voxel
            active[t] = True
            samples = []
            for name, camera in scene.cameras.items():
                uv, _ = camera.project(positions[t])
                column = np.clip(uv[:, 0].astype(int), 0, camera.width - 1)
                row = np.clip(uv[:, 1].astype(int), 0, camera.height - 1)
                samples.append(scene.image(name, t)[row, column] / 255.0)
            colors[t] = np.median(samples, axis=0)
        background = np.mean([scene.image(name, 0).mean(axis=(0, 1)) for name in scene.train], axis=0) / 255.0
        return Model(scene.times, positions, active, colors, background, fields.voxel)

    def load(self, directory: Path, scene: TrainingScene) -> Model:
        with np.load(directory / "model.npz", allow_pickle=False) as data:
            return Model(scene.times, *(data[name] for name in Model.ARRAYS))


class Model(Fitted):
    ARRAYS = ("positions", "active", "colors", "background", "radius")

    def __init__(self, times, positions, active, colors, background, radius) -> None:  # type: ignore[no-untyped-def]
        self.times, self.positions, self.active, self.colors = times, positions, active, colors
        self.background, self.radius = background, float(radius)

    def render(self, camera: Camera, time: float) -> Render:
        t = int(np.abs(self.times - time).argmin())
        active = self.active[t]
        n = int(active.sum())
        factors = np.broadcast_to(np.eye(3, dtype=np.float32) * self.radius / 2, (n, 3, 3))  # of covariances B B^T
        opacities = np.full(n, 0.8, np.float32)
        points, colors = self.positions[t][active], self.colors[t][active]
        return Render(*rasterize_arrays(points, factors, opacities, colors, camera, background=self.background))

    def particles(self) -> Particles:
        # Points are drawn anew in every frame. Even and odd frames take rows of their own, so that no row claims to be
        # one particle followed from a frame to the next.
        rows = np.arange(len(self.positions))[:, None] % 2 == np.arange(2).repeat(self.positions.shape[1])
        return Particles(np.tile(self.positions, (1, 2, 1)), np.tile(self.active, (1, 2)) & rows)

    def save(self, directory: Path) -> None:
        np.savez(directory / "model.npz", **{name: getattr(self, name) for name in self.ARRAYS})
