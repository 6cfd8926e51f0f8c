"""Static Scaffold-GS anchors: the background of other methods (`fit_background`, `Background`), and a method itself."""

from .background import Background, Plates, clean_plates, completed, fit_background, flat_background
from .background_reuse import shared_background
from .method import ScaffoldGS, StaticScene
from .settings import BackgroundSettings

__all__ = [
    "Background",
    "BackgroundSettings",
    "Plates",
    "ScaffoldGS",
    "StaticScene",
    "clean_plates",
    "completed",
    "fit_background",
    "flat_background",
    "shared_background",
]
