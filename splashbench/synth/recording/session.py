"""A synthetic session: what seven cameras and a handheld sweep would have recorded of a pour, with exact truth.

The folder has the layout `splashbench prepare` reads (docs: capture), and under truth/ what a real capture can never
know.
"""

from __future__ import annotations

import multiprocessing
import os
import tempfile
from collections.abc import Callable
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Any

import numpy as np

from splashbench import toml
from splashbench.errors import SplashbenchError
from splashbench.files import atomic_directory, write_model
from splashbench.files.ply import write_mesh
from splashbench.progress import track
from splashbench.synth.imaging.geometry import bowl_mesh
from splashbench.synth.imaging.room import board_pose
from splashbench.synth.liquid import simulation
from splashbench.synth.liquid.trajectory import Trajectory
from splashbench.synth.recording import jobs
from splashbench.synth.recording import plan as planned
from splashbench.synth.recording.plan import BOARD, CAMERAS, RecordingOptions, RecordingPlan, make_plan
from splashbench.synth.recording.truth import TruthCamera, TruthFile, TruthLens, TruthPour, TruthSound

PARTICLE_HZ = 240  # cubic interpolation between the stored instants is then good to about 0.1 mm
_SWEEP_CHUNK = 11


def make_session(out: Path, options: RecordingOptions, replace: bool = False, workers: int | None = None) -> Path:
    """Make a session in the new folder `out` with `workers` processes (default: one per core); returns `out`.

    Raises SplashbenchError when the liquid solver cannot run or `out` exists and `replace` is false.
    """
    plan = make_plan(options)
    with (
        atomic_directory(Path(out), replace=replace, holds="truth/truth.json") as directory,
        tempfile.TemporaryDirectory(prefix="splashbench-") as scratch,
    ):
        running = simulation.start(plan.pour, bowl_mesh(), Path(scratch))
        try:
            with _pool(workers) as pool:
                _still_recordings(pool, plan, directory)
                trajectory = running.finish()
                first_seen = _pour_recordings(pool, plan, trajectory, directory)
        except BrokenProcessPool:
            raise SplashbenchError(
                f"a worker process died while making {out}, most likely for want of memory; "
                "give a smaller --size or close other programs"
            ) from None
        finally:
            running.stop()
        _write_truth(plan, trajectory, first_seen, directory)
        (directory / "session.toml").write_text(toml.dumps(_description(plan)), encoding="utf-8")
    return Path(out)


def _pool(workers: int | None) -> ProcessPoolExecutor:
    count = workers or max(1, len(os.sched_getaffinity(0)))
    # Spawned, not forked: the libraries used here start threads, which a fork would leave in an undefined state.
    context = multiprocessing.get_context("spawn")
    return ProcessPoolExecutor(min(count, len(CAMERAS)), mp_context=context, initializer=jobs.prepare_worker)


def _gather(futures: list[Future[Any]], description: str) -> None:
    """Wait for all with a bar; the first failure ends the rest."""
    try:
        for future in track(as_completed(futures), description, total=len(futures)):
            future.result()
    except BaseException:
        for future in futures:
            future.cancel()
        # Leaving the pool would wait for what is under way, which takes minutes.
        for process in multiprocessing.active_children():
            process.terminate()
        raise


def _still_recordings(pool: ProcessPoolExecutor, plan: RecordingPlan, directory: Path) -> None:
    """Sweep, static scene and calibration clips: all that needs no liquid."""
    chunks = [
        range(start, min(start + _SWEEP_CHUNK, planned.SWEEP_FRAMES))
        for start in range(0, planned.SWEEP_FRAMES, _SWEEP_CHUNK)
    ]
    sweep = [pool.submit(jobs.sweep_frames, plan, chunk) for chunk in chunks]
    makers: list[Callable[[RecordingPlan, str, Path], None]] = [jobs.static_clip, jobs.intrinsics_clip]
    clips: list[Future[Any]] = [pool.submit(maker, plan, name, directory) for maker in makers for name in CAMERAS]
    _gather([*sweep, *clips], "static scene, sweep and boards")
    jobs.write_sweep(plan, [frame for chunk in sweep for frame in chunk.result()], directory)


def _pour_recordings(pool: ProcessPoolExecutor, plan: RecordingPlan, trajectory: Trajectory, directory: Path) -> float:
    """All cameras' recordings of the pour; returns the common time at which liquid comes into view."""
    recordings = [pool.submit(jobs.pour_recording, plan, name, trajectory, directory) for name in CAMERAS]
    _gather(list(recordings), "pour recordings")
    return min(future.result() for future in recordings)


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
    write_mesh(truth / "container.ply", bowl.vertices, bowl.faces)


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
