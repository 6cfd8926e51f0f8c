"""Deformable-3DGS: canonical Gaussians and a network that moves them (Yang et al., CVPR 2024)."""

from .method import Deformable3DGS

__all__ = ["Deformable3DGS"]
