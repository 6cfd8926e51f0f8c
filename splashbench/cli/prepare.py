"""`splashbench prepare SESSION SCENE`: make a calibrated, synchronised, masked and cropped scene of raw recordings."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from splashbench.cli.arguments import add_replace, positive_number, whole_number
from splashbench.cli.command import add_command
from splashbench.cli.output import emit, say, table

_EPILOG = """\
examples:
  splashbench prepare sessions/monday --init --square-metres 0.03               write session.toml
  splashbench prepare sessions/monday scenes/monday
  splashbench prepare sessions/monday scenes/monday --masks sam3_masks --interval 12.4 17.7 --replace
  splashbench prepare sessions/monday scenes/monday --from masks --replace      the masks and the scene once more

SESSION holds session.toml and the cameras' own files. Each camera has three clips: the board; the textured
static scene with the board flat on the table; the pour, with sound. A handheld sweep shows the static scene.
SCENE is written only where every essential gate passes. Its prepare_report.html shows every stage's outcome.

With --init, leave SCENE out; --replace is then for session.toml. It recognises ChArUco boards and checkerboards, and
takes folders of photographs for the board, the static scene and the sweep.

Results of each stage are cached in SESSION/prepare. The next run repeats only what has changed, and continues a run
that was stopped. Stages, in order: sync, motion, intrinsics, poses, metric, container, masks, scene.
"""

# As in session.toml (splashbench.prepare.session), repeated here so that `--help` need not import it.
_MAX_TIMESTEPS = 10_000
# As in splashbench.prepare.stage_cache, likewise.
_STAGES = ("sync", "motion", "intrinsics", "poses", "metric", "container", "masks", "scene")


class _WithoutScene(argparse.Action):
    """A flag that makes SCENE optional. (With nargs="?", no option could stand between SESSION and SCENE.)"""

    def __init__(self, option_strings: Sequence[str], dest: str, scene: argparse.Action, help: str) -> None:
        super().__init__(option_strings, dest, nargs=0, default=False, help=help)
        self._scene = scene

    def __call__(self, parser: object, namespace: argparse.Namespace, *_: object) -> None:
        setattr(namespace, self.dest, True)
        self._scene.required = False


def register(subparsers: argparse._SubParsersAction) -> None:
    """Add the command to the parser."""
    parser = add_command(
        subparsers,
        "prepare",
        run,
        summary="make a scene from raw recordings",
        description="Calibrate, synchronise, sample, mask, undistort and crop the recordings of SESSION into SCENE.",
        epilog=_EPILOG,
    )
    parser.add_argument("session", type=Path, metavar="SESSION", help="folder with session.toml")
    scene = parser.add_argument("scene", type=Path, metavar="SCENE", help="folder to be made")
    parser.add_argument(
        "--init",
        action=_WithoutScene,
        scene=scene,
        help="write SESSION/session.toml from what the recordings show, and no scene",
    )
    parser.add_argument(
        "--square-metres",
        type=positive_number("metres", below=10),
        metavar="M",
        help="with --init: side of one square of the printed board",
    )
    parser.add_argument(
        "--masks",
        metavar="background|FOLDER",
        help="liquid masks: by background subtraction, or FOLDER/<camera>/<source frame:06d>.png of the raw frames;"
        " default: as session.toml says",
    )
    parser.add_argument(
        "--timesteps",
        type=whole_number(2, _MAX_TIMESTEPS),
        metavar="N",
        help="number of timesteps; default: as session.toml says",
    )
    parser.add_argument(
        "--interval",
        nargs=2,
        type=float,
        metavar=("START", "END"),
        help="motion interval in seconds on the first camera's clock; default: detected in the images",
    )
    parser.add_argument("--no-crop", action="store_true", help="keep whole frames instead of the paper's crop")
    parser.add_argument(
        "--image-format", choices=("png", "jpg"), default="png", help="format of the frames (default: png)"
    )
    parser.add_argument(
        "--from",
        dest="again_from",
        choices=_STAGES,
        metavar="STAGE",
        help="repeat this stage and those after it, although nothing has changed",
    )
    parser.add_argument(
        "--work", type=Path, metavar="DIR", help="cache of the stages' results (default: SESSION/prepare)"
    )
    add_replace(parser, "SCENE")


def _require_none_of_a_scene(arguments: argparse.Namespace) -> None:
    """A usage error for an option that says how a scene is made, which `--init` makes none of."""
    given = {
        "--masks": arguments.masks is not None,
        "--timesteps": arguments.timesteps is not None,
        "--interval": arguments.interval is not None,
        "--no-crop": arguments.no_crop,
        "--image-format": arguments.image_format != "png",
        "--from": arguments.again_from is not None,
        "--work": arguments.work is not None,
    }
    named = ", ".join(flag for flag, is_given in given.items() if is_given)
    if named:
        arguments.usage_error(
            f"--init makes no scene: {named} would do nothing; write it into session.toml, or give it to "
            "`splashbench prepare SESSION SCENE`"
        )


def _describe(arguments: argparse.Namespace) -> int:
    """Handle `splashbench prepare SESSION --init`."""
    from splashbench.prepare.init.description import describe

    description = describe(arguments.session, arguments.square_metres, arguments.replace)
    rows = [
        [video.camera or "none", video.subject or "not used", str(len(video.files)), video.files[0]]
        for video in description.recordings
    ]
    say(table(["camera", "shows", "files", "first file"], rows))
    if description.board is not None:
        board = description.board
        say(f"board: {board.squares_x}x{board.squares_y} squares, {board.dictionary or board.kind}")
    for line in description.to_do:
        say(f"to do: {line}")
    say(f"wrote {description.path}; check it, then run: splashbench prepare {arguments.session} SCENE")
    if arguments.json:
        emit(
            {
                "session": str(description.path),
                "cameras": list(description.cameras),
                "films": [
                    {"camera": r.camera, "shows": r.subject, "files": list(r.files)} for r in description.recordings
                ],
                "board": vars(description.board) if description.board else None,
                "to_do": list(description.to_do),
            }
        )
    return 0


def run(arguments: argparse.Namespace) -> int:
    """Handle `splashbench prepare`."""
    if arguments.init:
        if arguments.scene is not None:
            arguments.usage_error("--init writes session.toml and makes no scene; leave SCENE out")
        _require_none_of_a_scene(arguments)
        return _describe(arguments)
    if arguments.square_metres is not None:
        arguments.usage_error("--square-metres goes with --init")
    from splashbench.errors import SplashbenchError
    from splashbench.prepare.pipeline import PrepareOptions, prepare

    interval = None
    if arguments.interval is not None:
        interval = (arguments.interval[0], arguments.interval[1])
        if not -1e6 < interval[0] < interval[1] < 1e6:
            raise SplashbenchError(
                f"--interval {interval[0]:g} {interval[1]:g}: give seconds, START before END, both below a million"
            )
    options = PrepareOptions(
        masks=arguments.masks,
        timesteps=arguments.timesteps,
        interval=interval,
        crop=not arguments.no_crop,
        replace=arguments.replace,
        image_format=arguments.image_format,
        work=arguments.work,
        again_from=arguments.again_from,
    )
    try:
        preparation = prepare(arguments.session, arguments.scene, options)
    except SplashbenchError as error:
        # The traceback holds the progress bar that was running; without it the bar ends its line before the error's.
        raise error.with_traceback(None) from None
    rows = [
        [gate.name, gate.figure, f"{gate.side} {gate.limit:.4g}", "passed" if gate.passed else "WARNING"]
        for gate in preparation.gates
    ]
    say(table(["gate", "value", "limit", "outcome"], rows))
    for gate in preparation.warnings:
        say(f"warning: {gate.name} is {gate.figure}: {gate.detail}; {gate.remedy}")
    seconds_spent = {name: record.spent for name, record in preparation.stages.items() if not record.reused}
    reused = [name for name, record in preparation.stages.items() if record.reused]
    spent = ", ".join(f"{name} {seconds:.1f}" for name, seconds in seconds_spent.items())
    unchanged = f"; unchanged: {', '.join(reused)}" if reused else ""
    say(f"wrote {arguments.scene} in {sum(seconds_spent.values()):.0f} s ({spent}{unchanged})")
    if arguments.json:
        stages = {
            name: {"seconds": round(r.seconds, 3), "spent": round(r.spent, 3), "reused": r.reused}
            for name, r in preparation.stages.items()
        }
        passed = not preparation.warnings
        emit({"scene": str(arguments.scene), "passed": passed, **preparation.as_json(), "stages": stages})
    return 0
