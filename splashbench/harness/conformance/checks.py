"""The checks of the conformance test, in the order in which a method's author can mend what they find."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from splashbench.harness.conformance import model_checks, scene_checks, stop_checks
from splashbench.harness.conformance.findings import Found
from splashbench.harness.conformance.trial import Trial


@dataclass(frozen=True)
class Check:
    """One line of the test: its name, what it asks for, what to do where it fails, and how it is found out."""

    name: str
    about: str
    remedy: str
    look: Callable[[Trial], Found]


CHECKS: tuple[Check, ...] = (
    Check(
        "metadata",
        "id, title, presets and settings are valid and survive being written",
        "mend the class's attributes and its Config, see CONTRIBUTING.md",
        model_checks.description,
    ),
    Check(
        "fit",
        "a run through the harness ends as ok",
        "mend fit(), load() and render() until this run is ok",
        model_checks.fit,
    ),
    Check(
        "progress",
        "fit() reports its progress, in [0, 1], never backwards, and says what it does",
        "call run.progress(fraction, message) as the fit goes on",
        model_checks.progress,
    ),
    Check(
        "files",
        "save() writes plain files and no pickles",
        "write arrays with numpy.savez and settings as JSON; a pickle from a stranger runs code when it is read",
        model_checks.files,
    ),
    Check(
        "load",
        "loaded in a fresh process, from another place, the model renders the same bytes",
        "save everything that render() needs, in full precision, in the folder that save() is given",
        model_checks.load,
    ),
    Check(
        "again",
        "views rendered twice, in any order, are the same bytes",
        "let render() draw no random numbers and keep nothing from call to call that changes the result",
        model_checks.again,
    ),
    Check(
        "views",
        "every test view at every timestep has its size, is finite and in [0, 1]",
        "mend render(); what lies outside of [0, 1] by more than 0.5, and integers, are refused",
        model_checks.views("test"),
    ),
    Check(
        "between",
        "views between the timesteps, and a little outside of them, are whole as well",
        "render() is asked for any time; take the nearest timestep, or carry the liquid there",
        model_checks.views("between"),
    ),
    Check(
        "size",
        "a camera of another size and focal length is rendered at its own size",
        "take width, height and K from the camera that render() is given, never from the training views",
        model_checks.views("size"),
    ),
    Check(
        "principal_point",
        "a window of a view, with its principal point off the middle, shows that part of the view",
        "project with camera.K or camera.project(), principal point included",
        model_checks.views("window"),
    ),
    Check(
        "particles",
        "particles, where there are any, are finite and cover the timesteps",
        "return None or Particles of positions [T, N, 3] with T the scene's timesteps",
        model_checks.held(lambda answer: answer.particles),
    ),
    Check(
        "signed_distance",
        "the signed distance, where there is one, covers the timesteps",
        "return None or a SignedDistance of phi [T, nx, ny, nz] with T the scene's timesteps",
        model_checks.held(lambda answer: answer.geometry),
    ),
    Check(
        "same_seed",
        "two fits with one seed give the same bytes",
        "draw every random number from generators seeded with run.seed; depend on no time, path, hash order or race",
        scene_checks.same_seed,
    ),
    Check("other_seed", "another seed is accepted", "take any seed of 0 or more", scene_checks.other_seed),
    Check(
        "hidden_test_views",
        "without the test images, masks and truth the result is the same",
        "use what TrainingScene gives, and nothing else",
        scene_checks.hidden,
    ),
    Check(
        "unread_test_views",
        "no test image, mask or truth is opened, nor looked for",
        "read images and masks through scene.image() and scene.mask() of training cameras alone",
        scene_checks.unread,
    ),
    Check(
        "unchanged_scene",
        "the scene is left as it was",
        "write into run.directory; the scene's files are links to the user's own",
        scene_checks.unchanged,
    ),
    Check(
        "writes",
        "files are written in run.directory, the model's folder, the temporary folder and caches alone",
        "write scratch files into run.directory, which the harness removes",
        scene_checks.elsewhere,
    ),
    Check(
        "time_limit",
        "a fit that takes too long is stopped, with status timeout and nothing half-written",
        "write nothing beside the folders that the harness gives, and leave signals and process groups as they are",
        stop_checks.time_limit,
    ),
    Check(
        "signals",
        "stopped by SIGTERM or Ctrl-C in the middle of the fit, a run leaves nothing half-written",
        "write nothing beside the folders that the harness gives, and leave signals and process groups as they are",
        stop_checks.signals,
    ),
    Check(
        "processes",
        "no process outlives its run",
        "start processes in the method's own process group (no start_new_session, no daemons) and end them",
        stop_checks.processes,
    ),
    Check(
        "one_frame",
        "a scene of one timestep is reconstructed, or refused with a reason",
        "return Support(False, reason) from supports(), or raise SplashbenchError with one clear line",
        scene_checks.edge(lambda trial: trial.one_frame),
    ),
    Check(
        "no_liquid",
        "a scene without liquid is reconstructed, or refused with a reason",
        "return Support(False, reason) from supports(), or raise SplashbenchError with one clear line",
        scene_checks.edge(lambda trial: trial.no_liquid),
    ),
)
