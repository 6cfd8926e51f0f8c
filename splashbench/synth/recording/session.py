"""A synthetic session: what seven cameras and a handheld sweep would have recorded of a pour, with exact truth.

The folder has the layout `splashbench prepare` reads (docs: capture), and under truth/ what a real capture can never
know.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from splashbench import toml
from splashbench.errors import SplashbenchError
from splashbench.files import atomic_directory, write_model
from splashbench.files.ply import write_mesh
from splashbench.synth.imaging.geometry import bowl_mesh
from splashbench.synth.imaging.rendering import view_bytes
from splashbench.synth.imaging.room import board_pose
from splashbench.synth.liquid import simulation
from splashbench.synth.liquid.trajectory import Trajectory
from splashbench.synth.recording import jobs
from splashbench.synth.recording import plan as planned
from splashbench.synth.recording.jobs import PourFilm
from splashbench.synth.recording.plan import BOARD, CAMERAS, RecordingOptions, RecordingPlan, make_plan
from splashbench.synth.recording.truth import TruthCamera, TruthFile, TruthLens, TruthPour, TruthSound
from splashbench.synth.workers import Job, Workers, worker_count

PARTICLE_HZ = 240  # cubic interpolation between the stored instants is then good to about 0.1 mm
_SWEEP_CHUNK = 11


def make_session(out: Path, options: RecordingOptions, replace: bool = False, workers: int | None = None) -> Path:
    """Make a session in the new folder `out` with `workers` processes; returns `out`.

    By default there is one for each core, as far as memory goes.

    Raises SplashbenchError when the liquid solver cannot run or `out` exists and `replace` is false.
    """
    plan = make_plan(options)
    with (
        atomic_directory(Path(out), replace=replace, holds="truth/truth.json") as directory,
        tempfile.TemporaryDirectory(prefix="splashbench-") as scratch,
    ):
        most = 2 * len(CAMERAS)  # more would set up cameras for a handful of frames
        count = min(workers, most) if workers else worker_count(view_bytes(*options.size), most)
        running = simulation.start(plan.pour, bowl_mesh(), Path(scratch))
        try:
            with Workers(count, plan, made=str(out)) as still:
                _still_recordings(still, plan, directory)
            trajectory = running.finish()
        finally:
            running.stop()
        first_seen = _pour_recordings(count, plan, trajectory, directory, Path(scratch))
        _write_truth(plan, trajectory, first_seen, directory)
        (directory / "session.toml").write_text(toml.dumps(_description(plan)), encoding="utf-8")
    return Path(out)


def _still_recordings(workers: Workers[RecordingPlan], plan: RecordingPlan, directory: Path) -> None:
    """Sweep, static scene and calibration clips: all that needs no liquid."""
    chunks = [
        range(start, min(start + _SWEEP_CHUNK, planned.SWEEP_FRAMES))
        for start in range(0, planned.SWEEP_FRAMES, _SWEEP_CHUNK)
    ]
    sweep: list[Job] = [(jobs.sweep_frames, (chunk,)) for chunk in chunks]
    clips: list[Job] = [
        (maker, (name, directory)) for maker in (jobs.static_clip, jobs.intrinsics_clip) for name in CAMERAS
    ]
    made = workers.each([*sweep, *clips], "static scene, sweep and boards")
    jobs.write_sweep(plan, [frame for chunk in made[: len(sweep)] for frame in chunk], directory)


def _pour_recordings(count: int, plan: RecordingPlan, trajectory: Trajectory, directory: Path, scratch: Path) -> float:
    """All cameras' recordings of the pour; returns the common time at which liquid comes into view."""
    film = PourFilm(plan, trajectory, directory, scratch)
    frames = {name: recorder.n_frames for name, recorder in plan.recorders.items()}
    with Workers(count, film, made=str(directory)) as workers:
        return float(min(workers.film(frames, PourFilm.shoot, "pour recordings", PourFilm.finish)))


def _write_truth(plan: RecordingPlan, trajectory: Trajectory, first_seen: float, directory: Path) -> None:
    truth = directory / "truth"
    if not np.isfinite(first_seen):
        raise SplashbenchError("no camera saw any liquid; give a longer --duration")
    sounds = {"clap": plan.sources[0].position.tolist(), "pour": plan.sources[1].position.tolist()}
    cameras = {
        name: TruthCamera(
            **_lens(recorder.camera),
            w2c=recorder.camera.w2c.tolist(),
            start_s=recorder.start_s,
            clock_rate=recorder.clock_rate,
            fps=recorder.fps,
        )
        for name, recorder in plan.recorders.items()
    }
    file = TruthFile(
        schema_version=1,
        reference=planned.REFERENCE,
        cameras=cameras,
        sweep=TruthLens(**_lens(plan.sweep[0])),
        sound=TruthSound(clap_time_s=planned.CLAP_AT, clap_position=sounds["clap"], pour_position=sounds["pour"]),
        gravity=list(planned.GRAVITY),
        pour=TruthPour(start_s=first_seen, end_s=plan.end),
        board_pose=board_pose(BOARD).tolist(),
        seed=plan.options.seed,
    )
    write_model(truth / "truth.json", file)
    _write_particles(truth / "particles.npz", plan, trajectory)
    bowl = bowl_mesh()
    write_mesh(truth / "container.ply", bowl.vertices, bowl.outward_faces)


def _lens(camera: Any) -> dict[str, Any]:
    return {
        "width": camera.width,
        "height": camera.height,
        "K": camera.K.tolist(),
        "distortion": camera.distortion.tolist(),
    }


def _write_particles(path: Path, plan: RecordingPlan, trajectory: Trajectory) -> None:
    """Positions, velocities and existence on a uniform grid of common times from the first drop to the end."""
    steps = round(plan.pour.duration * PARTICLE_HZ)
    since_start = np.arange(steps + 1) / PARTICLE_HZ
    # The last instant itself, not the rest after it: there the velocities are still those of the motion.
    states = [trajectory.at(min(time, trajectory.end - 1e-9)) for time in since_start]
    active = np.stack([state[2] for state in states])
    np.savez_compressed(
        path,
        positions=np.stack([state[0] for state in states]) * active[..., None],
        velocities=np.stack([state[1] for state in states]) * active[..., None],
        active=active,
        times=since_start + planned.POUR_AT,
    )


def _description(plan: RecordingPlan) -> dict[str, Any]:
    """The contents of session.toml."""
    return {
        "schema_version": 1,
        "name": "synthetic_pour",
        "cameras": list(CAMERAS),
        "train": list(planned.TRAIN),
        "test": list(planned.TEST),
        "timesteps": 50,
        "board": BOARD,
        "recordings": {
            "pour": {name: jobs.pour_files(plan.recorders[name]) for name in CAMERAS},
            "static": {name: [jobs.STATIC_FILE.format(name)] for name in CAMERAS},
            "intrinsics": {name: [jobs.INTRINSICS_FILE.format(name)] for name in CAMERAS},
        },
        "sweep": {"files": [jobs.SWEEP_FILE]},
        "masks": {"provider": "background"},
    }
