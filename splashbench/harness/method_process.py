"""The child process in which a method runs, fits or renders, as a request file says.

This is the harness's code around the method's: it marks when the fit starts and ends, checks every render, and tells
what came out. The clock is outside (keeper.py), since a method can do whatever this process can. Fitting and rendering
are two processes, so that a model which renders only in the memory that fitted it fails.
"""

from __future__ import annotations

import importlib
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, TextIO

from splashbench.errors import SplashbenchError
from splashbench.files import raise_if_disk_full, read_model
from splashbench.harness.channel import FIT_ENDS, FIT_STARTS, SAVED, TIMING_ENDS, TIMING_STARTS, Channel
from splashbench.harness.checkpoints import Checkpoints
from splashbench.harness.contract import Fitted, Method, Run
from splashbench.harness.discovery import load_method
from splashbench.harness.external.importers import Importer, load_importer
from splashbench.harness.messages import Failure, Outcome, Request, lacks_memory
from splashbench.harness.output_checks import check_geometry, check_particles, checked_render
from splashbench.scene import Camera, Scene, TrainingScene
from splashbench.scene.particles import most_particles
from splashbench.submission import Status, to_8bit, write_view
from splashbench.submission.exr import write_exr

WARM_UP_FRAMES = 10


def carry_out(request_path: str, channel: Channel | None = None) -> int:
    """Carry out the request; always tells `channel` an Outcome unless the process dies or the disk is full."""
    request, channel = read_model(Path(request_path), Request), channel or Channel()
    phases: dict[str, Callable[[Request, Any, TrainingScene, Channel], Outcome]] = {
        "fit": _fit,
        "import": _import,
        "render": _render,
    }
    phase = phases[request.phase]
    try:
        method: Method | Importer = load_importer(request.importer) if request.importer else load_method(request.method)
        outcome = phase(request, method, Scene.open(Path(request.scene)).training(), channel)
    except Failure as failure:
        outcome = Outcome(status=failure.status, reason=failure.reason)
    except MemoryError as error:
        outcome = Outcome(status=Status.OUT_OF_MEMORY, reason=f"out of memory {error}".strip())
    except Exception as error:
        raise_if_disk_full(getattr(error, "filename", None) or request.model, error)
        if lacks_memory(str(error)):
            outcome = Outcome(status=Status.OUT_OF_MEMORY, reason=_one_line(error))
        else:
            import traceback

            traceback.print_exc()
            outcome = Outcome(status=Status.CRASHED, reason=_one_line(error))
    channel.finish(outcome.model_dump(mode="json"))
    return 0


def _one_line(error: BaseException) -> str:
    text = " ".join(str(error).split())[:300]
    return text if isinstance(error, SplashbenchError) else f"{type(error).__name__}: {text}"


def _load_compiler() -> None:
    """PyTorch loads its compiler, which takes seconds, when a first optimiser is made: no more a part of a fit than
    loading PyTorch itself, which methods have done by now."""
    if "torch" in sys.modules:
        importlib.import_module("torch._dynamo")


def _fit(request: Request, method: Method, scene: TrainingScene, channel: Channel) -> Outcome:
    config = method.Config.preset(request.preset, request.overrides)
    support = method.supports(scene)
    if not support.ok:
        raise Failure(Status.UNSUPPORTED, support.reason or "the method gave no reason")
    if method.torch_optim:
        _load_compiler()
    with Path(request.progress).open("a", encoding="utf-8") as stream:
        run = Run(
            seed=request.seed,
            device=request.device,
            directory=Path(request.scratch),
            budget_seconds=request.budget_seconds,
            budget=request.budget,
            cache=Path(request.cache) if request.cache else None,
            _report=_reporter(stream),
        )
        channel.mark(FIT_STARTS)
        start = time.perf_counter()
        if request.checkpoints:
            run._checkpoints = Checkpoints(
                Path(request.checkpoints),
                request.marks,
                lambda: run.fit_seconds(time.perf_counter() - start),
                _synchronise,
                channel.mark,
            )
        fitted = method.fit(scene, config, run)
        _synchronise()
        channel.mark(FIT_ENDS)
    fitted.save(Path(request.model))
    channel.mark(SAVED)
    return Outcome(
        overhead_seconds=run._overhead_seconds,
        checkpoints=run._checkpoints.seconds if run._checkpoints else [],
        reused=run.reused,
        stages=run.stages,
        notes=run.notes,
        decisions=run.decisions,
        peak_device_memory_bytes=_device_peak(),
        renderer=_renderers(),
    )


def _import(request: Request, importer: Importer, scene: TrainingScene, channel: Channel) -> Outcome:
    fitted = importer.read(Path(request.source), Path(request.export), scene)
    fitted.save(Path(request.model))
    return Outcome(peak_device_memory_bytes=_device_peak(), renderer=_renderers())


def _reporter(stream: TextIO) -> Callable[[float, str], None]:
    def report(fraction: float, message: str) -> None:
        stream.write(f"{fraction:.4f} {' '.join(message.split())}\n")
        stream.flush()

    return report


def _render(request: Request, method: Method | Importer, scene: TrainingScene, channel: Channel) -> Outcome:
    fitted = method.load(Path(request.model), scene)
    fitted.to_device(request.device)
    output = Path(request.output)
    views = requested_views(request, scene)
    counts = []
    with Path(request.progress).open("a", encoding="utf-8") as stream:
        report = _reporter(stream)
        for i, (camera, t, time) in enumerate(views):
            _reset_primitive_counter()
            where = f"camera {camera.name}, timestep {t}"
            render = checked_render(fitted.render(camera, time), camera, where)
            counts.append(_primitive_count())
            write_view(output, camera.name, t, to_8bit(render.rgb), to_8bit(render.alpha))
            if request.exr:
                write_exr(output / "exr" / camera.name / f"{t:06d}.exr", render.rgb, render.alpha)
            report(
                (i + 1) / len(views), f"rendering the {'test' if request.training_views is None else 'training'} views"
            )
    # On fewer timesteps than the scene's there is nothing to compare particles and distances with.
    bare = request.only_views or request.times is not None or request.training_views is not None
    notes: dict[str, str] = {}
    particles = None if bare else fitted.particles()
    if particles is not None:
        check_particles(particles, scene.n_frames)
        # A fit is not lost for having more than a file may hold.
        kept = particles.share(most_particles(scene.n_frames))
        if kept.count < particles.count:
            notes["particles"] = f"{kept.count} of {particles.count}, an even share: a file holds no more of them"
        kept.save(output / "particles.npz")
    geometry = None if bare else fitted.signed_distance()
    if geometry is not None:
        check_geometry(geometry, scene.n_frames)
        geometry.save(output / "geometry.npz")
    counted = [count for count in counts if count is not None]
    return Outcome(
        notes=notes,
        render_fps=_frame_rate(fitted, scene, request.timing_frames, channel),
        primitives_per_frame=statistics.fmean(counted) if counted else None,
        peak_device_memory_bytes=_device_peak(),
        renderer=_renderers(),
    )


def requested_views(request: Request, scene: TrainingScene) -> list[tuple[Camera, int, float]]:
    """What is rendered: camera, the timestep that its files are named by, and seconds."""
    if request.training_views is not None:
        pairs = [(scene.cameras[name], t) for name, steps in request.training_views.items() for t in steps]
        return [(camera, t, _time(scene, camera, t)) for camera, t in pairs]
    times = request.times or {name: scene.camera_times[name].tolist() for name in scene.test_cameras}
    return [(scene.test_cameras[name], t, time) for name, seconds in times.items() for t, time in enumerate(seconds)]


def _time(scene: TrainingScene, camera: Camera, t: int) -> float:
    """When the photograph that the view is compared with was taken, seconds."""
    return float(scene.camera_times[camera.name][t])


def _frame_rate(fitted: Fitted, scene: TrainingScene, frames: int, channel: Channel) -> float | None:
    """Frames per second: median of at least `frames` synchronised renders after a warm-up, without I/O.

    Protocol v1 (docs/protocol.md, cost).
    """
    if frames < 1:
        return None
    cameras = list(scene.test_cameras.values())
    seconds = []
    channel.mark(TIMING_STARTS)
    for i in range(WARM_UP_FRAMES + frames):
        camera, t = cameras[i % len(cameras)], (i // len(cameras)) % scene.n_frames
        _synchronise()
        start = time.perf_counter()
        fitted.render(camera, _time(scene, camera, t))
        _synchronise()
        if i >= WARM_UP_FRAMES:
            seconds.append(time.perf_counter() - start)
    channel.mark(TIMING_ENDS)
    return 1.0 / max(statistics.median(seconds), 1e-9)


def _cuda() -> Any:
    """torch.cuda where the method uses a device; torch is never imported, nor a device woken, for this alone."""
    torch = sys.modules.get("torch")
    return torch.cuda if torch is not None and torch.cuda.is_initialized() else None


def _synchronise() -> None:
    cuda = _cuda()
    if cuda is not None:
        cuda.synchronize()


def _device_peak() -> int | None:
    cuda = _cuda()
    return int(cuda.max_memory_allocated()) if cuda is not None else None


def _reset_primitive_counter() -> None:
    counters = sys.modules.get("splashbench.render.counters")
    if counters is not None:
        counters.reset()


def _primitive_count() -> int | None:
    """Primitives that the shared renderer drew since the last reset, or None for a renderer of the method's own."""
    counters = sys.modules.get("splashbench.render.counters")
    return int(counters.total()) if counters is not None and counters.calls() else None


def _renderers() -> list[str]:
    """The backends of the shared renderer that this process used."""
    counters = sys.modules.get("splashbench.render.counters")
    return list(counters.backends()) if counters is not None else []
