"""Session to scene: every stage of `splashbench prepare`, in order (paper Sec. 3 and S1).

Clocks from the sound, the motion interval and its timesteps, lenses from the board clips, poses from the static scene
and the sweep, metres from the board, masks, undistortion, the crop. What a stage finds is kept (`stages`), so that a
run that was stopped goes on where it was, and only what has changed is done anew. The scene appears only when all has
succeeded; its bytes do not depend on how often that was interrupted.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from splashbench.container.verification import overlay
from splashbench.errors import SplashbenchError
from splashbench.files import atomic_directory, is_staged_for, sha256_file, write_json, write_text
from splashbench.prepare import container as container_stage
from splashbench.prepare import gates as g
from splashbench.prepare.audio import clocks as listening
from splashbench.prepare.audio import sync
from splashbench.prepare.audio.clocks import Listening, SoundPaths
from splashbench.prepare.audio.sync import ClockFit, SequenceSync
from splashbench.prepare.calibration.board import Detector
from splashbench.prepare.calibration.intrinsics import Calibration
from splashbench.prepare.calibration.lens import Lens
from splashbench.prepare.calibration.undistort import Undistorter
from splashbench.prepare.container import PlacedContainer
from splashbench.prepare.crop import Box
from splashbench.prepare.masks import production as masking
from splashbench.prepare.masks.provider import Mask
from splashbench.prepare.masks.sheet import SheetCell, sheet_times, small_cell
from splashbench.prepare.poses import metric, rig
from splashbench.prepare.poses.scale import SceneFrame
from splashbench.prepare.preparation import MaskRecord, Preparation
from splashbench.prepare.report import html_report
from splashbench.prepare.session import DESCRIPTION, Session
from splashbench.prepare.stage_cache import Stage, StageStore, facts_of, open_stages
from splashbench.prepare.video import motion, sampling
from splashbench.prepare.video.recording import Recording, probe
from splashbench.progress import track
from splashbench.scene.camera import Camera
from splashbench.scene.container import ContainerMesh, read_mesh
from splashbench.scene.layout import SceneMeta
from splashbench.scene.writer import write_scene

SHEET_COLUMNS = 6  # timesteps on the report's contact sheet
OVERLAY_WIDTH = 480  # pixels of a frame with the container drawn on it
WORK_FOLDER = "prepare"  # within the session
_UNFINISHED = "unfinished_scene.txt"

ImageFormat = Literal["png", "jpg"]
Image = NDArray[np.uint8]


@dataclass(frozen=True)
class Options:
    """What a user may change. `None`: as session.toml says.

    `masks`: "background", or a folder of masks; `interval`: seconds on the reference camera's clock. `work`: where the
    stages' results are kept, SESSION/prepare unless given; `again_from`: this stage and those after it are done anew.
    """

    masks: str | None = None
    timesteps: int | None = None
    interval: tuple[float, float] | None = None
    crop: bool = True
    replace: bool = False
    image_format: ImageFormat = "png"
    work: Path | None = None
    again_from: Stage | None = None


def prepare(session_directory: Path, scene_directory: Path, options: Options | None = None) -> Preparation:
    """Make a scene from a session, with prepare_report.json and prepare_report.html in it.

    Raises SplashbenchError, and leaves no scene, where a file is unusable or an essential gate fails.
    """
    options = options or Options()
    session = Session.open(session_directory)
    if options.masks not in (None, "background") and not Path(options.masks).is_dir():
        raise SplashbenchError(f"{options.masks} is not a folder of masks; give one, or --masks background")
    work = options.work or session.directory / WORK_FOLDER
    with (
        open_stages(work, options.again_from) as store,
        _unfinished_removed(work, scene_directory),
        atomic_directory(
            scene_directory, replace=options.replace, holds="train_meta.json", inputs=[session_directory, work]
        ) as made,
    ):
        (work / _UNFINISHED).write_text(str(made), encoding="utf-8")
        preparation = _Run(session, options, store).into(made)
        write_json(made / "prepare_report.json", preparation.as_json())
        write_text(made / "prepare_report.html", html_report(preparation))
    return preparation


@contextmanager
def _unfinished_removed(work: Path, scene_directory: Path) -> Iterator[None]:
    """Remove the half-written scene of a run that was killed; its place is noted in `work` while one is written.

    Only beside the scene that is asked for now: a note in a stranger's session must not delete anything else.
    """
    note = work / _UNFINISHED
    if note.is_file():
        left = Path(note.read_bytes()[:4096].decode("utf-8", "replace"))
        if is_staged_for(left, scene_directory):
            shutil.rmtree(left, ignore_errors=True)
    yield
    note.unlink(missing_ok=True)


@dataclass
class _Run:
    """One preparation: the session, what the user changes, and the store of results."""

    session: Session
    options: Options
    store: StageStore
    sheet: dict[str, list[SheetCell]] = field(default_factory=dict)
    overlays: dict[str, Image] = field(default_factory=dict)

    def into(self, directory: Path) -> Preparation:
        """Run all stages; the scene is written into `directory`."""
        session, cameras = self.session, self.session.cameras
        recordings = rig.RigRecordings(session)
        self._check_what_later_stages_need()
        # The cheap stages that most often find a fault come first.
        heard = self._listening()
        interval = self._interval(heard.clocks)
        sequence = self._left_over(heard.clocks, interval)
        sampled = self._sampling(heard.clocks, interval, "sampling_by_arrival")
        calibrations = self._calibrations(recordings)
        lenses = {camera: calibration.lens for camera, calibration in calibrations.items()}
        recordings.check_sizes(lenses, self.pour)
        posed = self._posed(recordings, lenses)
        undistorters = {camera: Undistorter(lens) for camera, lens in lenses.items()}
        container_masks = container_stage.container_masks(session.container_folder, undistorters)
        frame = self._metric(posed, undistorters, container_masks, recordings.detector)
        placed = metric.transformed(posed.poses, frame.scene_from_sfm)
        whole = _pinholes(lenses, placed.w2c)
        paths = self._sound_paths(whole)
        clocks = sync.shifted(heard.clocks, paths.shift_s) if paths.applied else heard.clocks
        if paths.applied:
            sampled = self._sampling(clocks, interval, "sampling")
        gates = [
            *g.intrinsics_gates(calibrations),
            *g.sync_gates(clocks, sequence),
            *g.pose_gates(placed, cameras, lenses[cameras[0]].width),
            *g.metric_gates(frame),
            *g.sampling_gates(sampled),
        ]
        g.require(gates, str(session.directory))

        container = self._container(whole, container_masks, undistorters)
        if container is not None:
            gates += g.container_gates(container, session.train, lenses[cameras[0]].width)
            g.require(gates, str(session.container_mesh))
        record, store = self._masks(sampled, undistorters, clocks, interval.start)
        windows = store.windows(undistorters, self.options.crop)
        gates += g.mask_gates(record.health, len(sampled.times))
        gates.append(g.source_gate({name: undistorters[name].source_share(windows[name]) for name in cameras}))

        with self.store.timed("scene"):
            write_scene(
                directory,
                cameras={
                    name: camera.cropped(windows[name].x0, windows[name].y0, windows[name].width, windows[name].height)
                    for name, camera in whole.items()
                },
                train=session.train,
                test=session.test,
                n_frames=len(sampled.times),
                frames=self._frames(
                    sampled, undistorters, store, windows, record, self._overlays(container, whole, container_masks)
                ),
                meta=self._meta(sampled, windows, record.provider, container),
                initial_points=metric.initial_points(placed),
                container_masks={name: windows[name].cut(mask) for name, mask in container_masks.items()},
                image_format=self.options.image_format,
            )
            if container is not None:
                container_stage.put_into_scene(session, directory)
        return Preparation(
            session=session,
            heard=heard,
            calibrations=calibrations,
            clocks=clocks,
            sound_paths=paths,
            sequence=sequence,
            poses=placed,
            metric=frame,
            motion=interval,
            sampling=sampled,
            masks=record,
            container=container,
            windows=windows,
            cropped=self.options.crop,
            gates=gates,
            stages=dict(self.store.records),
            sheet=self.sheet,
            overlays=self.overlays,
        )

    def _check_what_later_stages_need(self) -> None:
        """Faults that can be seen at once are told at once, not after the hours of the stages before."""
        if self.container_mesh is not None:
            sizes = {camera: probe(recording.paths[0]) for camera, recording in self.pour.items()}
            container_stage.check_masks(self.session, {name: (i.width, i.height) for name, i in sizes.items()})
        if self.options.masks is None and self.session.masks.provider == "sam3":
            masking.sam3_provider(self.session, self.pour)

    @cached_property
    def container_mesh(self) -> ContainerMesh | None:
        """The scanned container in its own coordinates, where the session has one."""
        path = self.session.container_mesh
        return None if path is None else read_mesh(path)

    @cached_property
    def pour(self) -> dict[str, Recording]:
        """Every camera's recording of the pour."""
        return {camera: Recording(self.session.paths("pour", camera)) for camera in self.session.cameras}

    def _files(self, camera: str) -> list[tuple[str, int, int]]:
        return facts_of(self.pour[camera].paths)

    @cached_property
    def _all_files(self) -> dict[str, Any]:
        return {camera: self._files(camera) for camera in self.session.cameras}

    def _listening(self) -> Listening:
        inputs = {"files": self._all_files, "reference": self.session.reference}
        return self.store.result("sync", Listening, inputs, lambda: listening.listen(self.pour, self.session.reference))

    def _interval(self, clocks: Mapping[str, ClockFit]) -> motion.MotionInterval:
        # Held-out views decide nothing about a scene, not even when it begins.
        seen = self.session.train
        override = self.options.interval or self.session.motion_interval
        inputs = {"files": {camera: self._files(camera) for camera in seen}, "clocks": clocks, "given": override}
        return self.store.result(
            "motion", motion.MotionInterval, inputs, lambda: motion.find_motion(self.pour, clocks, seen, override)
        )

    def _left_over(self, clocks: Mapping[str, ClockFit], interval: motion.MotionInterval) -> SequenceSync:
        inputs = {"files": self._all_files, "clocks": clocks, "interval": interval.interval}
        reference = self.session.reference
        return self.store.result(
            "motion",
            SequenceSync,
            inputs,
            lambda: listening.left_over(self.pour, clocks, interval.interval, reference),
            part="left_over",
        )

    def _sampling(
        self, clocks: Mapping[str, ClockFit], interval: motion.MotionInterval, part: str
    ) -> sampling.Sampling:
        instants = sampling.sample_times(interval.interval, self.options.timesteps or self.session.timesteps)
        inputs = {"files": self._all_files, "clocks": clocks, "instants": instants}
        return self.store.result(
            "motion",
            sampling.Sampling,
            inputs,
            lambda: sampling.sample_frames(
                instants, {camera: found.frame_times for camera, found in self.pour.items()}, clocks
            ),
            part=part,
        )

    def _calibrations(self, recordings: rig.RigRecordings) -> dict[str, Calibration]:
        return {
            camera: self.store.result(
                "intrinsics",
                Calibration,
                {"files": facts_of(recordings.boards[camera].paths), "board": self.session.board},
                partial(recordings.calibrate, camera),
                part=camera,
            )
            for camera in track(self.session.cameras, "calibrating lenses")
        }

    def _posed(self, recordings: rig.RigRecordings, lenses: Mapping[str, Lens]) -> rig.PosedRig:
        inputs = {
            "static": {camera: facts_of(found.paths) for camera, found in recordings.static.items()},
            "sweep": facts_of(recordings.sweep.paths) if recordings.sweep else None,
            "lenses": lenses,
            "board": self.session.board,
            "marker": self.session.marker,
        }

        def make() -> rig.PosedRig:
            try:
                with self.store.scratch() as scratch:
                    return recordings.pose(lenses, scratch)
            except RuntimeError as error:  # COLMAP's, for one when its database finds the disk full
                raise SplashbenchError(
                    f"{self.session.directory}: COLMAP failed ({error}); check the space in {self.store.folder}"
                ) from None

        return self.store.result("poses", rig.PosedRig, inputs, make)

    def _metric(
        self,
        posed: rig.PosedRig,
        undistorters: Mapping[str, Undistorter],
        container_masks: Mapping[str, Mask],
        detector: Detector,
    ) -> SceneFrame:
        session = self.session
        inputs = {
            "posed": posed,
            "board": session.board,
            "marker": session.marker,
            "distance": session.distance,
            "container": session.container,
            "container_files": facts_of(container_stage.container_files(session)),
            "train": session.train,
        }

        def make() -> SceneFrame:
            container = None
            if self.container_mesh is not None and not rig.prints_are_seen(posed, session, detector):
                lenses = {camera: undistorter.lens for camera, undistorter in undistorters.items()}
                cameras = list(_pinholes(lenses, posed.poses.w2c).values())
                container = container_stage.upright_container(
                    session, self.container_mesh, cameras, container_masks, undistorters
                )
            return rig.find_frame(posed, session, detector, container)

        return self.store.result("metric", SceneFrame, inputs, make)

    def _sound_paths(self, whole: Mapping[str, Camera]) -> SoundPaths:
        """What the sound's travel does to the clocks, now that the cameras' places are known."""
        given = self.session.sound
        source = given.source if given else (0.0, 0.0, 0.0)
        positions = {name: camera.center for name, camera in whole.items()}
        distance, shift = sync.sound_paths(positions, source, self.session.reference)
        return SoundPaths(source, given is not None, distance, shift)

    def _container(
        self, whole: Mapping[str, Camera], masks: Mapping[str, Mask], undistorters: Mapping[str, Undistorter]
    ) -> PlacedContainer | None:
        """The container's mesh in the scene; `whole`: cameras of uncropped frames. None where the session has none."""
        mesh = self.container_mesh
        if mesh is None:
            return None
        inputs = {
            "files": facts_of(container_stage.container_files(self.session)),
            "described": self.session.container,
            "train": self.session.train,
            "cameras": {name: [camera.K, camera.w2c] for name, camera in whole.items()},
            "lenses": {name: undistorter.lens for name, undistorter in undistorters.items()},
        }
        return self.store.result(
            "container",
            PlacedContainer,
            inputs,
            lambda: container_stage.place_container(self.session, mesh, list(whole.values()), masks, undistorters),
        )

    def _overlays(
        self, container: PlacedContainer | None, whole: Mapping[str, Camera], masks: Mapping[str, Mask]
    ) -> Callable[[str, Image], None]:
        """Keeps, given a camera and an undistorted whole frame of it, the placed container drawn on it."""
        mesh = self.container_mesh
        if mesh is None or container is None:
            return lambda camera, image: None
        pose = container.placement.pose

        def keep(camera: str, image: Image) -> None:
            width = min(OVERLAY_WIDTH, whole[camera].width)
            self.overlays[camera] = overlay(mesh, pose, whole[camera], masks.get(camera), image, width)

        return keep

    def _masks(
        self,
        sampled: sampling.Sampling,
        undistorters: Mapping[str, Undistorter],
        clocks: Mapping[str, ClockFit],
        start: float,
    ) -> tuple[masking.MaskRecord, masking.MaskStore]:
        provider = masking.choose_provider(self.session, self.options.masks, self.pour, clocks, start)
        found = {}
        for camera in track(self.session.cameras, f"masks ({provider.name})"):
            indices = sampled.indices[camera].tolist()
            inputs = {
                "files": self._files(camera),
                "indices": indices,
                "lens": undistorters[camera].lens,
                "provider": provider.name,
                "made_from": provider.made_from(camera, indices),
            }
            found[camera] = self.store.files(
                "masks",
                masking.CameraMasks,
                inputs,
                partial(
                    masking.make_masks,
                    provider=provider,
                    camera=camera,
                    indices=indices,
                    undistorter=undistorters[camera],
                    source=self.pour[camera],
                ),
                part=camera,
            )
        store = masking.MaskStore(found)
        return store.record(provider.name, undistorters), store

    def _meta(
        self,
        sampled: sampling.Sampling,
        windows: Mapping[str, Box],
        provider: str,
        container: PlacedContainer | None,
    ) -> SceneMeta:
        mesh = self.session.container_mesh
        return SceneMeta(
            name=self.session.name,
            times=sampled.times.tolist(),
            camera_times={camera: times.tolist() for camera, times in sampled.camera_times.items()},
            metres_per_unit=1.0,
            gravity=metric.GRAVITY,
            container_mesh=None if mesh is None else container_stage.name_in_scene(mesh),
            container_pose=None if container is None else container.placement.pose.tolist(),
            container_transparent=None if self.session.container is None else self.session.container.transparent,
            provenance={
                "made_by": "splashbench prepare",
                "session_sha256": sha256_file(self.session.directory / DESCRIPTION),
                "masks": provider,
                "cropped": self.options.crop,
                "windows": {camera: [box.x0, box.y0, box.x1, box.y1] for camera, box in windows.items()},
                "source_frames": {camera: found.tolist() for camera, found in sampled.indices.items()},
            },
        )

    def _frames(
        self,
        sampled: sampling.Sampling,
        undistorters: Mapping[str, Undistorter],
        store: masking.MaskStore,
        windows: Mapping[str, Box],
        record: MaskRecord,
        keep_overlay: Callable[[str, Image], None],
    ) -> Iterator[tuple[str, int, Image, Mask]]:
        """The scene's images and masks, camera by camera; a few are kept for the contact sheet in passing."""
        shown = set(sheet_times(len(sampled.times), record.faults, SHEET_COLUMNS))
        for camera, recording in self.pour.items():
            window = windows[camera]
            kept = self.sheet.setdefault(camera, [])
            for t, (_, raw) in enumerate(recording.frames(sampled.indices[camera].tolist())):
                whole = undistorters[camera].image(raw)
                if t == 0:
                    keep_overlay(camera, whole)
                image, mask = window.cut(whole), window.cut(store.read(camera, t))
                if t in shown:
                    kept.append(small_cell(image, mask, record.faults[camera].get(t, "")))
                yield camera, t, image, mask


def _pinholes(lenses: Mapping[str, Lens], w2c: Mapping[str, NDArray[np.float64]]) -> dict[str, Camera]:
    """The cameras of undistorted, uncropped frames."""
    return {name: Camera(name, lens.width, lens.height, lens.K, w2c[name]) for name, lens in lenses.items()}
