"""`splashbench view`: look at a scene, a submission or two, in a browser."""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import TYPE_CHECKING

from splashbench.cli.arguments import image_size, whole_number
from splashbench.cli.command import add_command
from splashbench.cli.output import emit, say
from splashbench.errors import SplashbenchError

if TYPE_CHECKING:
    from splashbench.viewer.viewer import Viewer

_EPILOG = """\
examples:
  splashbench view scenes/bowl_001
  splashbench view submissions/bowl_001/splashsplat --scene scenes/bowl_001
  splashbench view submissions/a submissions/b              side by side, with one camera
  splashbench view scenes/bowl submissions/a --no-open      a reconstruction beside its scene
  splashbench view submissions/a --screenshot view.png --camera 3 --time 0.8
  splashbench view submissions/a --show particles cameras

On a machine without a screen: run it there with --no-open, and on yours `ssh -L 8080:localhost:8080 MACHINE`, then open
http://localhost:8080. Two halves take three ports, which the command names. It needs the extra `view`,
in a checkout: pip install -c constraints.txt -e '.[view]'
Layers for --show: liquid, background, particles, surface, cut, velocity, picture, container, points, cameras, grid.
"""

_HERE = "127.0.0.1"
_SIZE = (1200, 800)


def register(subparsers: argparse._SubParsersAction) -> None:
    """Add the command to the parser."""
    parser = add_command(
        subparsers,
        "view",
        run,
        summary="look at a scene or submissions in a browser, at any speed",
        description="Show a scene, a submission, or two side by side in a browser, and play them at any speed.",
        epilog=_EPILOG,
    )
    parser.add_argument(
        "places", type=Path, nargs="+", metavar="SCENE|SUBMISSION", help="one folder, or two to see side by side"
    )
    parser.add_argument(
        "--scene", type=Path, metavar="SCENE", help="the scene of the submissions: photographs, and the container"
    )
    parser.add_argument("--method", metavar="FILE.py:CLASS", help="a submission's method that is not installed")
    parser.add_argument("--time", type=_seconds, metavar="SECONDS", help="start at the timestep nearest to this time")
    parser.add_argument("--camera", metavar="NAME", help="with --screenshot: look through this camera")
    parser.add_argument("--show", nargs="+", metavar="LAYER", help="show these layers at first, and no others")
    parser.add_argument(
        "--host", metavar="ADDRESS", help=f"address to listen on (default: {_HERE}, this machine alone)"
    )
    parser.add_argument(
        "--port", type=whole_number(1, 65535), metavar="N", help="port to listen on (default: the first free from 8080)"
    )
    parser.add_argument("--no-open", action="store_true", help="open no browser; the address is printed")
    parser.add_argument(
        "--save-to", type=Path, metavar="FOLDER", help="for screenshots and camera paths (default: the browser's own)"
    )
    parser.add_argument(
        "--screenshot", type=Path, metavar="OUT.png", help="write what a headless browser shows, and end"
    )
    parser.add_argument(
        "--size", type=image_size, metavar="WxH", help="with --screenshot: its size (default: 1200x800)"
    )


def _seconds(text: str) -> float:
    try:
        seconds = float(text)
    except ValueError:
        seconds = math.nan
    if not math.isfinite(seconds):
        raise argparse.ArgumentTypeError(f"{text!r} is not a number of seconds")
    return seconds


def run(arguments: argparse.Namespace) -> int:
    """Handle `splashbench view`."""
    if len(arguments.places) > 2:
        arguments.usage_error(f"two can be seen side by side, not {len(arguments.places)}")
    if arguments.camera and not arguments.screenshot:
        arguments.usage_error("--camera is for --screenshot; in the browser choose one in the panel")
    if arguments.size and not arguments.screenshot:
        arguments.usage_error("--size is for --screenshot; in the browser the window has the size that you give it")
    for flag in ("host", "port", "save_to"):
        if arguments.screenshot and getattr(arguments, flag):
            arguments.usage_error(f"--{flag.replace('_', '-')} would do nothing with --screenshot; leave it out")
    arguments.size, arguments.host = arguments.size or _SIZE, arguments.host or _HERE
    if arguments.screenshot and len(arguments.places) == 2 and arguments.size[0] % 2:
        arguments.usage_error(f"--size: a width of {arguments.size[0]} does not halve; give an even one for two halves")
    from splashbench.files import require_folder_place, require_picture_place, require_unsealed_place

    if arguments.screenshot:
        require_picture_place(arguments.screenshot, *arguments.places)
    if arguments.save_to:
        require_folder_place(arguments.save_to)
        require_unsealed_place(arguments.save_to)
    from splashbench.viewer.server import is_loopback, require_viser

    require_viser()
    from splashbench.viewer.exhibit import SceneExhibit, open_exhibit
    from splashbench.viewer.panel import Panel
    from splashbench.viewer.viewer import Viewer

    methods = _methods_of(arguments.places, arguments.method)
    exhibits = [open_exhibit(place, arguments.scene, method) for place, method in zip(arguments.places, methods)]
    if arguments.camera:
        exhibits[0].camera(arguments.camera)
    if arguments.scene and all(isinstance(exhibit, SceneExhibit) for exhibit in exhibits):
        say("--scene is for submissions, and none was given; it is not used")
    viewer = Viewer(
        exhibits,
        arguments.host,
        None if arguments.screenshot else arguments.port,
        send_ahead=False if arguments.screenshot else None,
        on=arguments.show,
        save_to=arguments.save_to,
        makes_ahead=not arguments.screenshot,
    )
    try:
        if not arguments.screenshot:
            Panel(viewer)
        if arguments.time is not None:
            viewer.seek(exhibits[0].nearest(arguments.time))
        viewer.start()
        if arguments.screenshot:
            return _screenshot(viewer, arguments)
        if not is_loopback(arguments.host):
            say(f"warning: listening on {arguments.host}, so anybody on the network can look and press the buttons")
        _tell(viewer, arguments)
        viewer.run()
    finally:
        viewer.stop()
    return 0


def _methods_of(places: list[Path], method: str | None) -> list[str | None]:
    """`method`, FILE.py:CLASS, for each submission that is of it: of two, one may be of an installed method."""
    if method is None:
        return [None] * len(places)
    from splashbench.harness.discovery import load_method

    own = load_method(method).id
    found = [method if _identity_of(place) == own else None for place in places]
    if not any(found) and all(place.is_dir() for place in places):
        raise SplashbenchError(f"--method {method} is {own!r}, and nothing that is to be seen is of it; leave it out")
    return found


def _identity_of(place: Path) -> str | None:
    """Id of the method of the submission in `place`; None for a scene, or nothing, which is found at opening."""
    from splashbench.submission import Submission

    try:
        return Submission.open(place, verify=False).identity.method
    except SplashbenchError:
        return None


def _screenshot(viewer: Viewer, arguments: argparse.Namespace) -> int:
    from splashbench.files import write_png
    from splashbench.viewer.still import still

    image = still(viewer, arguments.size, arguments.camera)
    write_png(arguments.screenshot, image)
    say(f"wrote {arguments.screenshot} ({image.shape[1]}x{image.shape[0]})")
    if arguments.json:
        emit(_facts(viewer) | {"file": str(arguments.screenshot), "size": [image.shape[1], image.shape[0]]})
    return 0


def _facts(viewer: Viewer) -> dict[str, object]:
    exhibit = viewer.halves[0].stage.exhibit
    return {
        "shown": [
            {
                "folder": str(half.stage.exhibit.place),
                "name": half.stage.exhibit.name,
                "layers": list(half.stage.layers),
            }
            for half in viewer.halves
        ],
        "timesteps": exhibit.n_frames,
        "seconds": float(exhibit.times[-1] - exhibit.times[0]),
    }


def _tell(viewer: Viewer, arguments: argparse.Namespace) -> None:
    from splashbench.viewer.server import DEFAULT_PORT

    for half in viewer.halves:
        exhibit = half.stage.exhibit
        span = f"{exhibit.n_frames} timesteps in {exhibit.times[-1] - exhibit.times[0]:.3g} s"
        say(f"{exhibit.place}: {exhibit.name}, {span}, {len(exhibit.cameras)} cameras")
    if arguments.port is None and viewer.port != DEFAULT_PORT:
        say(f"port {DEFAULT_PORT} is in use; this is {viewer.port}")
    opens = not arguments.no_open and _has_screen()
    others = [half.server.get_port() for half in viewer.halves if half.server.get_port() != viewer.port]
    if arguments.json:
        emit(_facts(viewer) | {"address": viewer.address, "ports": [viewer.port, *others]})
        _flush()
    say(f"look at {viewer.address}{f' (and ports {others[0]}, {others[1]})' if others else ''}; Ctrl-C ends it")
    if opens:
        _open(viewer.address)


def _flush() -> None:
    """What reads the address waits for it while the command runs on."""
    import sys

    sys.stdout.flush()


def _has_screen() -> bool:
    """Whether a browser can be opened: without a screen it would be one of text, and take the terminal."""
    import os

    if os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"):
        return True
    say("there is no screen here to open a browser on; open the address yourself")
    return False


def _open(address: str) -> None:
    import webbrowser

    try:
        opened = webbrowser.open(address)
    except webbrowser.Error:
        opened = False
    if not opened:
        say("no browser could be opened; open the address yourself")
