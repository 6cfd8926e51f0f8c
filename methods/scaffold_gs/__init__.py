"""Static Scaffold-GS anchors: the background of other methods (`fit_background`, `Background`), and a method itself."""

from splashbench_methods.scaffold_gs.background import Background, fit_background
from splashbench_methods.scaffold_gs.method import ScaffoldGS, StaticScene
from splashbench_methods.scaffold_gs.settings import BackgroundSettings
from splashbench_methods.scaffold_gs.shared import shared_background

__all__ = ["Background", "BackgroundSettings", "ScaffoldGS", "StaticScene", "fit_background", "shared_background"]
