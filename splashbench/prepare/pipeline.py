"""Session to scene: every stage of `splashbench prepare`, in order (paper Sec. 3 and S1).

Clocks from the sound, lenses from the board clips, poses from the static scene and the sweep, metres from the board,
the motion interval and its timesteps, masks, undistortion, the crop. The scene appears only when all has succeeded.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from splashbench.errors import SplashbenchError
from splashbench.files import atomic_directory, sha256_file, write_json, write_text
from splashbench.prepare import gates as g
from splashbench.prepare import masking, metric, motion, rig, sampling, sync
from splashbench.prepare.crop import Box
from splashbench.prepare.lens import Lens
from splashbench.prepare.masks import Mask
from splashbench.prepare.preparation import Preparation
from splashbench.prepare.report import html_report, outlined
from splashbench.prepare.session import DESCRIPTION, Session
from splashbench.prepare.undistort import Undistorter
from splashbench.prepare.video import Recording
from splashbench.progress import track
from splashbench.scene.camera import Camera
from splashbench.scene.layout import SceneMeta
from splashbench.scene.writing import write_scene

AUDIO_RATE = 48000
THUMBNAILS = 3  # frames per camera on the report's page

ImageFormat = Literal["png", "jpg"]
Image = NDArray[np.uint8]


@dataclass(frozen=True)
class Options:
    """What a user may change. `None`: as session.toml says.

    `masks`: "background", or a folder of masks; `interval`: seconds on the reference camera's clock.
    """

    masks: str | None = None
    timesteps: int | None = None
    interval: tuple[float, float] | None = None
    crop: bool = True
    replace: bool = False
    image_format: ImageFormat = "png"


def prepare(session_directory: Path, scene_directory: Path, options: Options | None = None) -> Preparation:
    """Make a scene from a session, with prepare_report.json and prepare_report.html in it.

    Raises SplashbenchError, and leaves no scene, where a file is unusable or an essential gate fails.
    """
    options = options or Options()
    session = Session.open(session_directory)
    if options.masks not in (None, "background") and not Path(options.masks).is_dir():
        raise SplashbenchError(f"{options.masks} is not a folder of masks; give one, or --masks background")
    with atomic_directory(
        scene_directory, replace=options.replace, holds="train_meta.json", inputs=[session_directory]
    ) as made:
        with tempfile.TemporaryDirectory(prefix="splashbench-prepare-") as work:
            preparation = _Run(session, options, Path(work)).into(made)
        write_json(made / "prepare_report.json", preparation.as_json())
        write_text(made / "prepare_report.html", html_report(preparation))
    return preparation


@dataclass
class _Run:
    """One preparation: the session, a scratch folder, and the seconds every stage took."""

    session: Session
    options: Options
    work: Path
    stages: dict[str, float] = field(default_factory=dict)

    def into(self, directory: Path) -> Preparation:
        """Run all stages; the scene is written into `directory`."""
        session, cameras = self.session, self.session.cameras
        recordings = rig.RigRecordings(session)
        pour = {camera: Recording(session.paths("pour", camera)) for camera in cameras}
        # The cheap stages that most often find a fault come first.
        with self._stage("sync"):
            audio = {camera: pour[camera].audio(AUDIO_RATE) for camera in track(cameras, "reading sound")}
            clocks = sync.estimate_sync(audio, AUDIO_RATE, session.reference)
            sync.require_synced(clocks, {camera: pour[camera].paths[0] for camera in cameras})
        with self._stage("motion"):
            # Held-out views decide nothing about a scene, not even when it begins.
            override = self.options.interval or session.motion_interval
            interval = motion.find_motion(pour, clocks, session.train, override)
            instants = sampling.sample_times(interval.interval, self.options.timesteps or session.timesteps)
            sampled = sampling.sample_frames(instants, {name: pour[name].frame_times for name in cameras}, clocks)
            sequence = sync.sequence_sync_rms(audio, AUDIO_RATE, clocks, interval.interval, session.reference)
        with self._stage("intrinsics"):
            calibrations = recordings.calibrations()
            lenses = {camera: calibration.lens for camera, calibration in calibrations.items()}
            recordings.check_sizes(lenses, pour)
        with self._stage("poses"):
            static, sweep = recordings.static_images(), recordings.sweep_images()
            try:
                found = rig.find_poses(static, sweep, lenses, recordings.detector, self._folder("sfm"))
            except RuntimeError as error:  # COLMAP's, for one when its database finds the disk full
                raise SplashbenchError(
                    f"{session.directory}: COLMAP failed ({error}); check the space in {tempfile.gettempdir()}"
                ) from None
        with self._stage("metric"):
            frame = rig.find_metres(static, sweep, lenses, found, recordings.detector)
            placed = metric.transformed(found, frame.scene_from_sfm)
        gates = [
            *g.intrinsics_gates(calibrations),
            *g.sync_gates(clocks, sequence),
            *g.pose_gates(placed, cameras, lenses[cameras[0]].width),
            *g.metric_gates(frame),
            *g.sampling_gates(sampled),
        ]
        g.require(gates, str(session.directory))

        undistorters = {camera: Undistorter(lens) for camera, lens in lenses.items()}
        store = masking.MaskStore(self._folder("masks"))
        with self._stage("masks"):
            provider = masking.choose_provider(self._mask_folder(), pour, clocks, interval.start)
            record = store.fill(provider, sampled, undistorters, pour)
        windows = store.windows(undistorters, self.options.crop)
        gates += g.mask_gates(record.health, len(instants))
        gates.append(g.source_gate({name: undistorters[name].source_share(windows[name]) for name in cameras}))

        thumbnails: dict[str, list[Image]] = {camera: [] for camera in cameras}
        with self._stage("writing"):
            write_scene(
                directory,
                cameras={
                    camera: _cropped(camera, lens, placed.w2c[camera], windows[camera])
                    for camera, lens in lenses.items()
                },
                train=session.train,
                test=session.test,
                n_frames=len(instants),
                frames=_frames(pour, sampled, undistorters, store, windows, thumbnails),
                meta=self._meta(sampled, windows, record.provider),
                initial_points=metric.initial_points(placed),
                container_masks=masking.container_masks(session.container_folder, undistorters, windows),
                image_format=self.options.image_format,
            )
        return Preparation(
            session=session,
            calibrations=calibrations,
            clocks=clocks,
            sequence=sequence,
            poses=placed,
            metric=frame,
            motion=interval,
            sampling=sampled,
            masks=record,
            windows=windows,
            cropped=self.options.crop,
            gates=gates,
            stages=dict(self.stages),
            thumbnails=thumbnails,
        )

    @contextmanager
    def _stage(self, name: str) -> Iterator[None]:
        start = time.perf_counter()
        yield
        self.stages[name] = round(time.perf_counter() - start, 3)

    def _folder(self, name: str) -> Path:
        path = self.work / name
        path.mkdir()
        return path

    def _mask_folder(self) -> Path | None:
        """The folder of masks to use; None for background subtraction."""
        if self.options.masks is None:
            return self.session.mask_folder
        return None if self.options.masks == "background" else Path(self.options.masks)

    def _meta(self, sampled: sampling.Sampling, windows: Mapping[str, Box], provider: str) -> SceneMeta:
        return SceneMeta(
            name=self.session.name,
            times=sampled.times.tolist(),
            camera_times={camera: times.tolist() for camera, times in sampled.camera_times.items()},
            metres_per_unit=1.0,
            gravity=metric.GRAVITY,
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
    pour: Mapping[str, Recording],
    sampled: sampling.Sampling,
    undistorters: Mapping[str, Undistorter],
    store: masking.MaskStore,
    windows: Mapping[str, Box],
    thumbnails: Mapping[str, list[Image]],
) -> Iterator[tuple[str, int, Image, Mask]]:
    """The scene's images and masks, camera by camera; a few are kept as thumbnails in passing."""
    shown = set(np.linspace(0, len(sampled.times) - 1, THUMBNAILS).round().astype(int).tolist())
    for camera, recording in pour.items():
        window = windows[camera]
        for t, (_, raw) in enumerate(recording.frames(sampled.indices[camera].tolist())):
            image, mask = window.cut(undistorters[camera].image(raw)), window.cut(store.read(camera, t))
            if t in shown:
                thumbnails[camera].append(outlined(image, mask))
            yield camera, t, image, mask


def _cropped(name: str, lens: Lens, w2c: NDArray[np.float64], window: Box) -> Camera:
    camera = Camera(name, lens.width, lens.height, lens.K, w2c)
    return camera.cropped(window.x0, window.y0, window.width, window.height)
