"""`splashbench run-external SCENE OUT`: reconstruct a scene with a code that runs by its own commands."""

from __future__ import annotations

import argparse
from pathlib import Path

from splashbench.cli.arguments import EXPORT_FORMATS, add_points, add_run_options, add_scene
from splashbench.cli.command import add_command
from splashbench.cli.output import say
from splashbench.cli.run import report_submission

_DESCRIPTION = """\
Export SCENE, fit it by COMMAND, and write the submission OUT. Test images are never exported.

Commands may hold {scene} the exported scene, {out} a folder for the model, {into} a folder for renders/ and alpha/,
{views} the list of test views, {seed} {device} {frames} {seconds} {progress}; doubled braces are braces. Commands are
recorded in the submission. docs/external_methods.md explains the placeholders.
"""

_EPILOG = """\
examples:
  splashbench run-external SCENE OUT --name theirs --format blender \\
    --command "/envs/theirs/bin/python train.py -s {scene} -m {out} --seed {seed}" \\
    --render-command "/envs/theirs/bin/python render_views.py -m {out} --views {views} --to {into}"
  splashbench run-external SCENE OUT --name theirs --format nerfies --trained models/theirs --import deformable_3dgs

A code that crashes or hangs gives a submission with that status, and exit status 1. It is a program with your rights:
run a stranger's in a container.
"""


def register(subparsers: argparse._SubParsersAction) -> None:
    """Add the command to the parser."""
    parser = add_command(
        subparsers,
        "run-external",
        run,
        summary="reconstruct a scene with a code in an environment of its own",
        description=_DESCRIPTION,
        epilog=_EPILOG,
    )
    add_scene(parser)
    parser.add_argument("out", type=Path, metavar="OUT", help="folder of the submission, made by the run")
    parser.add_argument("--name", required=True, help="what the method is called in the submission")
    parser.add_argument("--format", choices=EXPORT_FORMATS, required=True, help="layout of the exported scene")
    model = parser.add_mutually_exclusive_group(required=True)
    model.add_argument(
        "--command", dest="fit_command", metavar="COMMAND", help="fits the scene; its time and memory are measured"
    )
    model.add_argument(
        "--trained",
        type=Path,
        metavar="DIR",
        help="instead of --command: a model trained earlier, on this scene as `scene export` wrote it with the same "
        "--format, --points and --blank-test-images; no fit time is recorded",
    )
    renders = parser.add_mutually_exclusive_group()
    renders.add_argument(
        "--render-command", metavar="COMMAND", help="writes the test views into {into}, where --command does not do it"
    )
    renders.add_argument(
        "--import",
        dest="importer",
        metavar="IMPORTER",
        help="reads the model in {out}: the name of an importer, or FILE.py:CLASS",
    )
    parser.add_argument(
        "--shell", action="store_true", help="run the commands by /bin/sh: pipes, variables, several lines"
    )
    parser.add_argument(
        "--directory", type=Path, default=Path(), metavar="DIR", help="where the commands run (default: here)"
    )
    parser.add_argument("--method-version", default="1", metavar="TEXT", help='version of the code (default: "1")')
    parser.add_argument("--preset", help='name of the settings that the commands hold (default: "external")')
    parser.add_argument(
        "--mixed",
        action="store_true",
        help="the code has one set of primitives for background and liquid; importers of official codes set this",
    )
    parser.add_argument(
        "--blank-test-images", action="store_true", help="export black test images, for codes that open them"
    )
    parser.add_argument("--masks", action="store_true", help="export the training views' liquid masks too")
    add_points(parser)
    parser.add_argument("--work", type=Path, metavar="DIR", help="a new folder for export, output and logs, which stay")
    add_run_options(parser)


def _usage_fault(arguments: argparse.Namespace) -> str | None:
    """What is wrong with the options together, or None."""
    if arguments.trained is not None and not (arguments.importer or arguments.render_command):
        return "--trained needs --import or --render-command: something has to read the model"
    if not arguments.importer and (arguments.exr or arguments.timing_frames is not None):
        return "--exr and --timing-frames need --import: splashbench then renders the views itself"
    return None


def run(arguments: argparse.Namespace) -> int:
    """Handle `splashbench run-external`."""
    fault = _usage_fault(arguments)
    if fault:
        arguments.usage_error(fault)
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
        version=arguments.method_version,
        mixed=arguments.mixed,
        render_command=arguments.render_command,
        importer=arguments.importer,
        shell=arguments.shell,
        directory=arguments.directory,
        blank_test_images=arguments.blank_test_images,
        masks=arguments.masks,
        points=arguments.points,
    )
    submission = run_external(
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
    return report_submission(submission, arguments)
