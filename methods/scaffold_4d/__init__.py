"""4D-Scaffold-GS: anchors in space-time, decoded into moving Gaussians that come and go (Cho et al. 2024)."""

from .method import Scaffold4D

__all__ = ["Scaffold4D"]
