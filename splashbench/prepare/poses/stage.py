"""The stages poses and metric: have the cameras stood still, structure from motion, then its metres and its up."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from splashbench.errors import SplashbenchError
from splashbench.native.memory import give_back
from splashbench.prepare.audio.sync import ClockFit
from splashbench.prepare.calibration.intrinsics import Calibration
from splashbench.prepare.poses import rig
from splashbench.prepare.poses.rig import PosedRig, RigRecordings
from splashbench.prepare.poses.scale import SceneFrame, Upright
from splashbench.prepare.poses.stillness import Stillness, find_stillness
from splashbench.prepare.stage_cache import FileFacts, StageStore, facts_of
from splashbench.prepare.video.pour import PourRecordings


def stillness(
    store: StageStore,
    recordings: RigRecordings,
    pour: PourRecordings,
    clocks: Mapping[str, ClockFit],
    interval: tuple[float, float],
) -> dict[str, Stillness]:
    """How far every camera's pictures of the pour are from its static picture; `interval`: seconds, reference clock."""
    inputs = {
        "static": {camera: facts_of(static.paths) for camera, static in recordings.static.items()},
        "pour": pour.all_files,
        "clocks": clocks,
        "interval": interval,
    }

    def compare() -> dict[str, Stillness]:
        found = find_stillness(recordings.static_image, pour.recordings, clocks, interval)
        recordings.forget_pictures()  # no later stage looks at them
        give_back()
        return found

    return store.result("poses", dict[str, Stillness], inputs, compare, part="stillness")


def posed_rig(store: StageStore, recordings: RigRecordings, calibrations: Mapping[str, Calibration]) -> PosedRig:
    """The cameras' poses in structure from motion's own units, and the prints that they see."""
    session = recordings.session
    lenses = {camera: calibration.lens for camera, calibration in calibrations.items()}
    covariance = {camera: calibration.lens_covariance for camera, calibration in calibrations.items()}
    inputs = {
        "static": {camera: facts_of(static.paths) for camera, static in recordings.static.items()},
        "sweep": facts_of(recordings.sweep.paths) if recordings.sweep else None,
        "extrinsics": {camera: facts_of(extrinsics.paths) for camera, extrinsics in recordings.extrinsics.items()},
        "lenses": lenses,
        "lens_covariance": covariance,
        "board": session.board,
        "marker": session.marker,
    }

    def pose() -> PosedRig:
        try:
            with store.scratch() as scratch:
                posed = recordings.pose(lenses, scratch, covariance)
            give_back()  # COLMAP's, as much again as all stages after it take
            return posed
        except RuntimeError as error:  # COLMAP's, for one when its database finds the disk full
            raise SplashbenchError(
                f"{session.directory}: COLMAP failed ({error}); check the space in {store.folder}"
            ) from None

    return store.result("poses", PosedRig, inputs, pose)


def metric_frame(
    store: StageStore,
    recordings: RigRecordings,
    posed: PosedRig,
    container_files: list[FileFacts],
    place_container: Callable[[], Upright | None],
) -> SceneFrame:
    """The scene's frame in metres.

    place_container: says which way is up from the container, in structure from motion's frame; None where the session
        has none. It is called only where neither board nor marker gives the scene its up.
    """
    session, detector = recordings.session, recordings.detector
    inputs = {
        "posed": posed,
        "board": session.board,
        "marker": session.marker,
        "distance": session.distance,
        "container": session.container,
        "container_files": container_files,
        "train": session.train,
    }

    def find() -> SceneFrame:
        container = None if rig.prints_are_seen(posed, session, detector) else place_container()
        return rig.find_frame(posed, session, detector, container)

    return store.result("metric", SceneFrame, inputs, find)
