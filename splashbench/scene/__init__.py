"""Scenes: cameras, times, split, images and masks; reading, writing and checking them (docs/scene_format.md)."""

from splashbench.scene.camera import Camera, look_at
from splashbench.scene.container import ContainerMesh
from splashbench.scene.gaussians import Gaussians
from splashbench.scene.geometry import SignedDistance
from splashbench.scene.layout import SceneMeta
from splashbench.scene.particles import Particles
from splashbench.scene.scene import Scene, TrainingScene
from splashbench.scene.velocity import VelocityField
from splashbench.scene.writer import write_scene

__all__ = [
    "Camera",
    "ContainerMesh",
    "Gaussians",
    "Particles",
    "Scene",
    "SceneMeta",
    "SignedDistance",
    "TrainingScene",
    "VelocityField",
    "look_at",
    "write_scene",
]
