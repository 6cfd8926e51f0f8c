"""Session to scene: the stages of `splashbench prepare`, in order (paper Sec. 3 and S1).

Clocks from the sound, the motion interval and its timesteps, lenses from the board clips, poses from the static scene
and the sweep, metres from the board, masks, undistortion, the crop. Each stage lives beside what it does; this module
orders them. The results of stages are cached (`stage_cache`): a run that was stopped goes on where it was, and only
what has changed is done anew. The scene appears only when all has succeeded. Its bytes do not depend on how often that
was interrupted.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from splashbench.errors import SplashbenchError
from splashbench.files import (
    atomic_directory,
    atomic_path,
    is_plain_file,
    is_staged_for,
    read_plain,
    write_json,
    write_text,
)
from splashbench.prepare import container as containers
from splashbench.prepare import gates as g
from splashbench.prepare.audio import clocks as audio
from splashbench.prepare.audio import sync
from splashbench.prepare.calibration import stage as calibration
from splashbench.prepare.calibration.lens import Lens
from splashbench.prepare.calibration.undistort import Undistorter, pinhole_cameras
from splashbench.prepare.gate import require, told_with
from splashbench.prepare.masks import stage as masks
from splashbench.prepare.masks.provider import Mask
from splashbench.prepare.masks.session_masks import sam3_provider
from splashbench.prepare.poses import metric
from splashbench.prepare.poses import stage as poses
from splashbench.prepare.poses.rig import PosedRig, RigRecordings
from splashbench.prepare.poses.scale import Upright
from splashbench.prepare.preparation import Preparation
from splashbench.prepare.report.page import html_report
from splashbench.prepare.scene_output import ImageFormat, SceneOutput
from splashbench.prepare.session import Session
from splashbench.prepare.stage_cache import Stage, StageStore, facts_of, open_stages
from splashbench.prepare.video import stage as video
from splashbench.prepare.video.pour import PourRecordings
from splashbench.scene.container import ContainerMesh, read_mesh

WORK_FOLDER = "prepare"  # within the session
_UNFINISHED = "unfinished_scene.txt"
_MAX_NOTE_BYTES = 1 << 16


@dataclass(frozen=True)
class PrepareOptions:
    """What a user may change. `None`: as session.toml says.

    Attributes:
        masks: "background", or a folder of masks.
        interval: seconds on the reference camera's clock.
        work: where the stages' results are cached, SESSION/prepare unless given.
        again_from: this stage and those after it are done anew.
    """

    masks: str | None = None
    timesteps: int | None = None
    interval: tuple[float, float] | None = None
    crop: bool = True
    replace: bool = False
    image_format: ImageFormat = "png"
    work: Path | None = None
    again_from: Stage | None = None


def prepare(session_directory: Path, scene_directory: Path, options: PrepareOptions | None = None) -> Preparation:
    """Make a scene from a session, with prepare_report.json and prepare_report.html in it.

    Raises SplashbenchError, and leaves no scene, where a file is unusable or an essential gate fails.
    """
    options = options or PrepareOptions()
    session = Session.open(session_directory)
    if options.masks not in (None, "background") and not Path(options.masks).is_dir():
        raise SplashbenchError(f"{options.masks} is not a folder of masks; give one, or --masks background")
    work = options.work or session.directory / WORK_FOLDER
    with (
        open_stages(work, options.again_from) as store,
        _unfinished_removed(work, scene_directory),
        atomic_directory(
            scene_directory, replace=options.replace, holds="train_meta.json", inputs=[session_directory, work]
        ) as staging,
    ):
        with atomic_path(work / _UNFINISHED) as note:
            note.write_bytes(os.fsencode(staging))  # a folder's name need not be UTF-8
        preparation = _run_stages(session, options, store, staging)
        write_json(staging / "prepare_report.json", preparation.as_json())
        write_text(staging / "prepare_report.html", html_report(preparation))
    return preparation


@contextmanager
def _unfinished_removed(work: Path, scene_directory: Path) -> Iterator[None]:
    """Remove the half-written scene of a run that was killed; its place is noted in `work` while one is written.

    Only beside the scene that is asked for now: a note in a stranger's session must not delete anything else.
    """
    note = work / _UNFINISHED
    if is_plain_file(note):
        unfinished = Path(os.fsdecode(read_plain(note, _MAX_NOTE_BYTES)))
        if is_staged_for(unfinished, scene_directory):
            shutil.rmtree(unfinished, ignore_errors=True)
    yield
    note.unlink(missing_ok=True)


def _run_stages(session: Session, options: PrepareOptions, store: StageStore, directory: Path) -> Preparation:
    """Run all stages; the scene is written into `directory`."""
    names, timesteps = session.cameras, options.timesteps or session.timesteps
    rig, pour = RigRecordings(session), PourRecordings(session)
    mesh = None if session.container_mesh is None else read_mesh(session.container_mesh)
    _check_what_later_stages_need(session, options, pour, rig, mesh)

    # The cheap stages that most often find a fault come first.
    synced = audio.sync_stage(store, pour, session.reference)
    clocks = synced.clocks
    interval = video.motion_interval(store, session, pour, clocks, options.interval)
    sequence = audio.sequence_sync(store, pour, clocks, interval.interval, session.reference)
    pour.forget_sound()
    sampled = video.sampled_frames(store, pour, clocks, interval, timesteps, "sampling_by_arrival")

    calibrations = calibration.calibrations(store, rig)
    lenses = {camera: result.lens for camera, result in calibrations.items()}
    widths = {camera: lenses[camera].width for camera in names}
    rig.check_sizes(lenses, pour.recordings)
    undistorters = {camera: Undistorter(lens) for camera, lens in lenses.items()}
    still = poses.stillness(store, rig, pour, clocks, interval.interval)
    gates = [
        *g.intrinsics_gates(calibrations),
        *g.sync_gates(clocks, sequence),
        *g.stillness_gates(still, widths),
    ]
    # The poses cost minutes and may fail for a reason that these gates know.
    with told_with(gates):
        posed = poses.posed_rig(store, rig, calibrations)
        container_masks = containers.container_masks(session.container_folder, undistorters)
        frame = poses.metric_frame(
            store,
            rig,
            posed,
            facts_of(containers.container_files(session)),
            lambda: _upright_container(session, mesh, posed, lenses, container_masks, undistorters),
        )
    scene_poses = metric.transformed(posed.poses, frame.scene_from_sfm)
    cameras = pinhole_cameras(lenses, scene_poses.w2c)
    paths = audio.sound_paths(session, cameras)
    if paths.applied:
        clocks = sync.shifted(clocks, paths.shift_s)
        sampled = video.sampled_frames(store, pour, clocks, interval, timesteps, "sampling")
    gates += [
        *g.pose_gates(scene_poses, widths),
        *g.metric_gates(frame),
        *g.sampling_gates(sampled),
    ]
    require(gates, str(session.directory))

    container = containers.container_stage(store, session, mesh, cameras, container_masks, undistorters)
    if container is not None:
        gates += g.container_gates(container, session.train, widths)
        require(gates, str(session.container_mesh))
    record, mask_store = masks.masks_of_frames(
        store, session, pour, options.masks, sampled, undistorters, clocks, interval.start
    )
    windows = mask_store.windows(undistorters, options.crop)
    gates += g.mask_gates(record.health, len(sampled.times))
    gates.append(g.source_gate({name: undistorters[name].source_share(windows[name]) for name in names}))

    output = SceneOutput(
        session=session,
        pour=pour,
        cameras=cameras,
        poses=scene_poses,
        undistorters=undistorters,
        sampled=sampled,
        record=record,
        masks=mask_store,
        windows=windows,
        cropped=options.crop,
        mesh=mesh,
        container=container,
        container_masks=container_masks,
    )
    with store.timed("scene"):
        pictures = output.write(directory, options.image_format)
    return Preparation(
        session=session,
        synced=synced,
        calibrations=calibrations,
        clocks=clocks,
        sound_paths=paths,
        sequence=sequence,
        poses=scene_poses,
        metric=frame,
        stillness=still,
        motion=interval,
        sampling=sampled,
        masks=record,
        container=container,
        windows=windows,
        cropped=options.crop,
        gates=gates,
        stages=dict(store.records),
        pictures=pictures,
    )


def _check_what_later_stages_need(
    session: Session,
    options: PrepareOptions,
    pour: PourRecordings,
    rig: RigRecordings,
    mesh: ContainerMesh | None,
) -> None:
    """Report at once what can be seen at once, not after the hours of the stages before."""
    headers = {camera: recording.headers for camera, recording in pour.recordings.items()}
    for recording in rig.videos():
        recording.require_one_size()
    containers.check_masks(session, {camera: (first.width, first.height) for camera, (first, *_) in headers.items()})
    if options.masks is None and session.masks.provider == "sam3":
        sam3_provider(session, pour.recordings)


def _upright_container(
    session: Session,
    mesh: ContainerMesh | None,
    posed: PosedRig,
    lenses: Mapping[str, Lens],
    container_masks: Mapping[str, Mask],
    undistorters: Mapping[str, Undistorter],
) -> Upright | None:
    if mesh is None:
        return None
    cameras = list(pinhole_cameras(lenses, posed.poses.w2c).values())
    return containers.upright_container(session, mesh, cameras, container_masks, undistorters)
