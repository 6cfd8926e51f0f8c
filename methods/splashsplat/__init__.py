"""SplashSplat: splashing liquids from masks and images, by carriers moved, corrected and refilled (README.md)."""

from .method import FittedSplashSplat, SplashSplat
from .settings import SplashSplatConfig

__all__ = ["FittedSplashSplat", "SplashSplat", "SplashSplatConfig"]
