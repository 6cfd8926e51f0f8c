"""4D-Scaffold-GS: anchors in space-time, decoded into moving Gaussians that come and go (Cho et al. 2024)."""

from splashbench_methods.scaffold_4d.method import Scaffold4D

__all__ = ["Scaffold4D"]
