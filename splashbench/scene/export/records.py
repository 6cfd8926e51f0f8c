"""Two files in every export: what it was made from (splashbench.json), and what to render (test_views.json)."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, ConfigDict

from splashbench.scene.camera import Camera
from splashbench.scene.export.content import Export, TestImages, max_static
from splashbench.scene.scene import Scene

#: The file by which an export is recognised.
FACTS = "splashbench.json"
TEST_VIEWS = "test_views.json"


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid")


class ExportFacts(_Strict):
    """splashbench.json: what an export is of, for whoever reads the results that a code makes from it.

    time_origin_seconds, time_span_seconds: a time t in [0, 1] is origin + t * span seconds on the scene's clock.
    """

    schema_version: Literal[1] = 1
    format: str
    scene: str
    scene_digest: str
    n_frames: int
    train: list[str]
    test: list[str]
    times_source: str
    time_origin_seconds: float
    time_span_seconds: float
    test_images: TestImages
    masks: bool
    static_points: int
    liquid_points: int


class WantedCamera(_Strict):
    """A camera of test_views.json: pinhole, OpenCV axes, pixel centres at +0.5, world to camera, scene units."""

    width: int
    height: int
    K: list[list[float]]
    w2c: list[list[float]]


class WantedView(_Strict):
    """A view to render: when, and into which files of the folder that a render command is given."""

    camera: str
    frame: int
    seconds: float
    time: float
    render: str
    alpha: str


class WantedViews(_Strict):
    """test_views.json: what is to be rendered."""

    schema_version: Literal[1] = 1
    scene: str
    time_origin_seconds: float
    time_span_seconds: float
    cameras: dict[str, WantedCamera]
    views: list[WantedView]

    @classmethod
    def of(cls, export: Export, name: str) -> WantedViews:
        """The test views of `export`, which is of the scene `name`."""
        return cls(
            scene=name,
            time_origin_seconds=export.clock.origin,
            time_span_seconds=export.clock.span,
            cameras={camera: _wanted_camera(export.scene.cameras[camera]) for camera in export.scene.test},
            views=[
                WantedView(
                    camera=view.camera.name,
                    frame=view.t,
                    seconds=view.seconds,
                    time=view.time,
                    render=f"renders/{view.camera.name}/{view.t:06d}.png",
                    alpha=f"alpha/{view.camera.name}/{view.t:06d}.png",
                )
                for view in export.test_views
            ],
        )


def _wanted_camera(camera: Camera) -> WantedCamera:
    return WantedCamera(width=camera.width, height=camera.height, K=camera.K.tolist(), w2c=camera.w2c.tolist())


def export_facts(export: Export, scene: Scene, format_name: str) -> ExportFacts:
    """splashbench.json of `export`, which is of `scene`."""
    return ExportFacts(
        format=format_name,
        scene=scene.name,
        scene_digest=scene.digest,
        n_frames=scene.n_frames,
        train=list(scene.train),
        test=list(scene.test),
        times_source=scene.times_source,
        time_origin_seconds=export.clock.origin,
        time_span_seconds=export.clock.span,
        test_images=export.test_images,
        masks=export.masks,
        static_points=min(len(export.points.static), max_static(format_name)),
        liquid_points=sum(len(points) for points in export.points.liquid),
    )
