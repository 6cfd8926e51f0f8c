"""The parts of a session that worker processes make, each from the plan alone (`session` hands them out).

Every job seeds its own random numbers from the session's seed, so the result does not depend on which worker does what.
"""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from splashbench.files import write_png
from splashbench.synth.imaging.rendering import RoomView, TracedRoom
from splashbench.synth.imaging.room import pour_room, static_room
from splashbench.synth.liquid.surface import liquid_surface
from splashbench.synth.liquid.trajectory import Trajectory
from splashbench.synth.recording import plan as planned
from splashbench.synth.recording.audio import SAMPLE_RATE, record, room_noise
from splashbench.synth.recording.board_clip import board_images, board_poses
from splashbench.synth.recording.plan import BOARD, CAMERAS, CHAPTERED, POUR_AT, RecordingPlan, RigCamera
from splashbench.synth.recording.video import SensorNoise, write_recording

Frame = NDArray[np.uint8]

INTRINSICS_FILE = "cameras/{}/intrinsics/GX010001.MP4"
STATIC_FILE = "cameras/{}/static/GX010002.MP4"
POUR_FILE = "cameras/{}/pour/GX{:02d}0003.MP4"
SWEEP_FILE = "sweep/GX010001.MP4"
_SWEEP_SAMPLES = 2


@lru_cache(maxsize=1)
def _static_room(seed: int) -> TracedRoom:
    return TracedRoom(static_room(seed, BOARD))


@lru_cache(maxsize=1)
def _pour_room(seed: int) -> TracedRoom:
    return TracedRoom(pour_room(seed))


def _seed(plan: RecordingPlan, what: int, recorder: RigCamera) -> tuple[int, ...]:
    return (plan.options.seed, what, CAMERAS.index(recorder.name))


def intrinsics_clip(plan: RecordingPlan, name: str, session: Path) -> None:
    """Write the clip of the board moved in front of camera `name`."""
    recorder = plan.recorders[name]
    rng = np.random.default_rng(_seed(plan, 10, recorder))
    noise = SensorNoise(*plan.options.size, _seed(plan, 11, recorder))
    poses = board_poses(recorder.camera, BOARD, rng)
    frames = (
        noise.expose(image)
        for image in board_images(recorder.camera, BOARD, poses, rng)
        for _ in range(planned.POSE_HOLD_FRAMES)
    )
    track = room_noise(len(poses) * planned.POSE_HOLD_FRAMES / plan.options.fps, _seed(plan, 12, recorder))
    write_recording(session / INTRINSICS_FILE.format(name), frames, plan.options.fps, track)


def static_clip(plan: RecordingPlan, name: str, session: Path) -> None:
    """Write camera `name`'s recording of the static scene."""
    recorder = plan.recorders[name]
    noise = SensorNoise(*plan.options.size, _seed(plan, 13, recorder))
    image = RoomView(_static_room(plan.options.seed), recorder.camera).image
    count = round(planned.STATIC_SECONDS * plan.options.fps)
    track = room_noise(count / plan.options.fps, _seed(plan, 14, recorder))
    path = session / STATIC_FILE.format(name)
    write_recording(path, (noise.expose(image) for _ in range(count)), plan.options.fps, track)


def sweep_frames(plan: RecordingPlan, frames: range) -> list[Frame]:
    """Some frames of the handheld sweep, noise included."""
    images = []
    local_rays = plan.sweep[frames.start].local_rays(_SWEEP_SAMPLES)  # of one camera, wherever it is held
    for frame in frames:
        noise = SensorNoise(*plan.options.size, (plan.options.seed, 15, frame))
        view = RoomView(_static_room(plan.options.seed), plan.sweep[frame], _SWEEP_SAMPLES, local_rays)
        images.append(noise.expose(view.image))
    return images


def write_sweep(plan: RecordingPlan, frames: list[Frame], session: Path) -> None:
    """Write the sweep from its frames."""
    track = room_noise(len(frames) / planned.SWEEP_FPS, (plan.options.seed, 16))
    write_recording(session / SWEEP_FILE, frames, planned.SWEEP_FPS, track)


class PourFilm:
    """What the cameras record of the pour; a worker's own. Frames wait in the folder `scratch` for their camera's end.

    trajectory: of the liquid. session: folder of the session.
    """

    def __init__(self, plan: RecordingPlan, trajectory: Trajectory, session: Path, scratch: Path) -> None:
        self._plan, self._trajectory, self._session, self._scratch = plan, trajectory, session, scratch
        self._set_up: tuple[str, RoomView, SensorNoise] | None = None

    def _camera(self, name: str) -> tuple[RoomView, SensorNoise]:
        if self._set_up is None or self._set_up[0] != name:
            self._set_up = None  # large
            plan, recorder = self._plan, self._plan.recorders[name]
            view = RoomView(_pour_room(plan.options.seed), recorder.camera)
            self._set_up = name, view, SensorNoise(*plan.options.size, _seed(plan, 17, recorder))
        return self._set_up[1:]

    def shoot(self, name: str, frames: range) -> float:
        """Film some frames of camera `name`, and write their true masks.

        Returns the common time at which liquid is first seen in them, infinity if never.
        """
        recorder, (view, noise) = self._plan.recorders[name], self._camera(name)
        truth, first_seen, images = self._session / "truth", np.inf, []
        if frames.start == 0:
            (truth / "masks" / name).mkdir(parents=True, exist_ok=True)  # of a camera that sees no liquid as well
            write_png(truth / "container_masks" / f"{name}.png", _as_png(view.container_mask))
        for frame in frames:
            time = recorder.common_time(frame)
            positions, _, active = self._trajectory.at(time - POUR_AT)
            shown = view.with_liquid(liquid_surface(positions[active], self._plan.pour.particle_radius))
            if shown.mask.any():
                write_png(truth / "masks" / name / f"{frame:06d}.png", _as_png(shown.mask))
                first_seen = min(first_seen, time)
            images.append(noise.expose(shown.image, frame))
        np.save(self._scratch / f"{name}_{frames.start:06d}.npy", np.stack(images))
        return first_seen

    def finish(self, name: str) -> None:
        """Write the recording of camera `name`, all of whose frames have been filmed."""
        plan, recorder = self._plan, self._plan.recorders[name]
        blocks = sorted(self._scratch.glob(f"{name}_*.npy"))
        exposed = (frame for block in blocks for frame in np.load(block))
        track = record(recorder.microphone, plan.sources, recorder.n_frames / recorder.fps)
        start = 0
        for chapter, stop in enumerate(_chapter_ends(recorder), start=1):
            samples = slice(round(start * SAMPLE_RATE / recorder.fps), round(stop * SAMPLE_RATE / recorder.fps))
            write_recording(
                self._session / POUR_FILE.format(name, chapter),
                (next(exposed) for _ in range(start, stop)),
                recorder.fps,
                track[samples],
                **_stamps(recorder, start),
            )
            start = stop
        for block in blocks:
            block.unlink()


def _chapter_ends(recorder: RigCamera) -> list[int]:
    """Frame numbers at which the recording's files end; the split falls into the middle of the pour."""
    if recorder.name != CHAPTERED:
        return [recorder.n_frames]
    return [round(0.6 * recorder.n_frames), recorder.n_frames]


def pour_files(recorder: RigCamera) -> list[str]:
    """The recording's files, in order, relative to the session."""
    return [POUR_FILE.format(recorder.name, k + 1) for k in range(len(_chapter_ends(recorder)))]


def _stamps(recorder: RigCamera, frame: int) -> dict[str, str]:
    """Creation time and timecode of a file, off by up to 20 ms as on synchronised action cameras."""
    rng = np.random.default_rng([*recorder.microphone.seed, 9])
    seconds = 10 * 3600 + recorder.common_time(frame) + float(rng.uniform(-0.02, 0.02))
    full_seconds = int(seconds)
    clock = f"{full_seconds // 3600:02d}:{full_seconds // 60 % 60:02d}:{full_seconds % 60:02d}"
    count = int((seconds - full_seconds) * recorder.fps)
    return {"created": f"2024-05-04T{clock}Z", "timecode": f"{clock}:{count:02d}"}


def _as_png(mask: NDArray[np.bool_]) -> Frame:
    return mask.astype(np.uint8) * 255
