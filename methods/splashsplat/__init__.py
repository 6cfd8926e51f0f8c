"""SplashSplat: splashing liquids from masks and images, by carriers moved, corrected and refilled (README.md)."""

from splashbench_methods.splashsplat.config import SplashSplatConfig
from splashbench_methods.splashsplat.method import FittedSplashSplat, SplashSplat

__all__ = ["FittedSplashSplat", "SplashSplat", "SplashSplatConfig"]
