"""Videos of a reconstruction: any view, orbit or camera path, at any speed, beside the photographs or another."""

from splashbench.video.film import Film
from splashbench.video.output import write_video
from splashbench.video.plan import make_film
from splashbench.video.settings import TRUTH, Comparison, VideoSettings

__all__ = ["TRUTH", "Comparison", "Film", "VideoSettings", "make_film", "write_video"]
