"""SpacetimeGaussians, full and lite: Gaussians that fade in and out and move on polynomials (Li et al., CVPR 2024)."""

from .method import SpacetimeGaussians, SpacetimeGaussiansLite

__all__ = ["SpacetimeGaussians", "SpacetimeGaussiansLite"]
