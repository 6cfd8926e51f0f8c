"""The options of `splashbench run external`: a stranger's code, run by its own commands."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from splashbench.cli.output import say
from splashbench.cli.scene import add_points

if TYPE_CHECKING:
    from splashbench.submission import Submission

NAME = "external"

#: Options that only a code of its own has, with what they are by default.
_OWN = {
    "name": None,
    "fit_command": None,
    "trained": None,
    "format": None,
    "render_command": None,
    "importer": None,
    "shell": False,
    "directory": None,
    "method_version": None,
    "mixed": False,
    "blank_test_images": False,
    "masks": False,
    "points": None,
    "work": None,
}


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options to the parser of `run`."""
    group = parser.add_argument_group(
        "a code of its own (METHOD external)",
        "Commands may hold {scene} the exported scene, {out} a folder for the model, {into} a folder for renders/ and\n"
        "  alpha/, {views} the list of test views, {seed} {device} {frames} {seconds} {progress}; doubled braces are\n"
        "  braces. They are recorded in the submission. docs/external_methods.md has examples.",
    )
    group.add_argument("--name", help="what the method is called in the submission")
    group.add_argument(
        "--command", dest="fit_command", metavar="COMMAND", help="fits the scene; clocked, and its memory measured"
    )
    group.add_argument(
        "--trained",
        type=Path,
        metavar="DIR",
        help="instead of --command: what it left as {out} earlier, trained on this scene as `scene export` with the "
        "same --format, --points and --blank-test-images wrote it; no fit time is recorded",
    )
    group.add_argument("--format", choices=("nerfies", "nerfstudio", "blender", "colmap"), help="of the exported scene")
    group.add_argument(
        "--render-command", metavar="COMMAND", help="writes the test views into {into}, where --command does not"
    )
    group.add_argument("--import", dest="importer", metavar="IMPORTER", help="reads {out}; a name, or FILE.py:CLASS")
    group.add_argument("--shell", action="store_true", help="commands are for /bin/sh: pipes, variables, several lines")
    group.add_argument("--directory", type=Path, metavar="DIR", help="where commands run (default: here)")
    group.add_argument("--method-version", metavar="TEXT", help='of the code (default "1")')
    group.add_argument(
        "--mixed",
        action="store_true",
        help="one set of primitives is background and liquid; the importers of official codes say so themselves",
    )
    group.add_argument("--blank-test-images", action="store_true", help="black images, for codes that open them")
    group.add_argument("--masks", action="store_true", help="export the training views' liquid masks too")
    add_points(group, default=None)
    group.add_argument("--work", type=Path, metavar="DIR", help="a new folder that keeps export, output and logs")


def fault(arguments: argparse.Namespace) -> str | None:
    """What is wrong with the options together, or None."""
    if arguments.method != NAME:
        for name, default in _OWN.items():
            if getattr(arguments, name) != default:
                return f"{_option(name)} is for METHOD external alone"
        return None
    for name in ("name", "format"):
        if getattr(arguments, name) is None:
            return f"METHOD external needs {_option(name)}"
    if arguments.fit_command is None and arguments.trained is None:
        return "METHOD external needs --command, or --trained where the model is there already"
    if arguments.fit_command is not None and arguments.trained is not None:
        return "--command and --trained are two ways to the same model; give one"
    if arguments.trained is not None and not (arguments.importer or arguments.render_command):
        return "--trained needs --import or --render-command: something has to read the model"
    if arguments.overrides:
        return "--set is for methods with settings; an external code's are in its commands"
    if arguments.render_command and arguments.importer:
        return "--render-command and --import are two ways to the same renders; give one"
    if not arguments.importer and (arguments.exr or arguments.timing_frames is not None):
        return "--exr and --timing-frames are for renders of our own, of methods and of --import"
    return None


def _option(name: str) -> str:
    named = {"importer": "--import", "fit_command": "--command"}
    return named.get(name, "--" + name.replace("_", "-"))


def run(arguments: argparse.Namespace) -> Submission:
    """Run the code that the options tell of."""
    from splashbench.cli.scene import POINTS
    from splashbench.harness.external.runner import ExternalCode, run_external
    from splashbench.harness.runner import TIMING_FRAMES
    from splashbench.observe import initial_points
    from splashbench.scene import Scene
    from splashbench.scene.export import remarks

    # The run puts the export into such a folder.
    for note in remarks(Scene.open(arguments.scene), arguments.format, Path("NeRF", "scene")):
        say(f"note: {note}")
    code = ExternalCode(
        name=arguments.name,
        command=arguments.fit_command or "",
        trained=arguments.trained,
        format=arguments.format,
        version=arguments.method_version or "1",
        mixed=arguments.mixed,
        render_command=arguments.render_command,
        importer=arguments.importer,
        shell=arguments.shell,
        directory=arguments.directory or Path(),
        blank_test_images=arguments.blank_test_images,
        masks=arguments.masks,
        points=POINTS if arguments.points is None else arguments.points,
    )
    return run_external(
        code,
        arguments.scene,
        arguments.out,
        initial_points=initial_points,
        preset=arguments.preset,
        seed=arguments.seed,
        device=arguments.device,
        timeout_seconds=arguments.timeout,
        timing_frames=TIMING_FRAMES if arguments.timing_frames is None else arguments.timing_frames,
        exr=arguments.exr,
        replace=arguments.replace,
        keep_model=not arguments.no_model,
        work=arguments.work,
    )
