"""Static Scaffold-GS anchors: the background of other methods (`fit_background`, `Background`), and a method itself."""

from .background import Background, fit_background
from .method import ScaffoldGS, StaticScene
from .settings import BackgroundSettings
from .shared import shared_background

__all__ = ["Background", "BackgroundSettings", "ScaffoldGS", "StaticScene", "fit_background", "shared_background"]
