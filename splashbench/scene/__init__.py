"""Scenes: cameras, times, split, images and masks; reading, writing and checking them (docs/scene_format.md)."""

from splashbench.scene.camera import Camera
from splashbench.scene.layout import SceneMeta
from splashbench.scene.particles import Particles
from splashbench.scene.scene import Scene, TrainingScene
from splashbench.scene.writing import write_scene

__all__ = ["Camera", "Particles", "Scene", "SceneMeta", "TrainingScene", "write_scene"]
