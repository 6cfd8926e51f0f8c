"""`splashbench download`: fetch what is needed and not ours to ship, once: LPIPS weights, released scenes."""

from __future__ import annotations

import argparse
import signal
from pathlib import Path
from typing import TYPE_CHECKING

from splashbench.cli.command import add_command, add_group
from splashbench.cli.output import emit, say, table

if TYPE_CHECKING:
    from splashbench.download.scenes import SceneReport

_LPIPS_EXAMPLES = """\
  splashbench download lpips-weights
  splashbench download lpips-weights --to weights            then score with --lpips-weights, or the variable
  splashbench download lpips-weights --from Downloads        the two files fetched by other means
"""
_SCENES_EXAMPLES = """\
  splashbench download scenes REAL                           all 20, cut to the container
  splashbench download scenes bowl_001 tank_002 REAL         two of them
  splashbench download scenes REAL --variant full crop       as recorded, too: with the masks of the container
  splashbench download scenes REAL --from real_scene.zip     the archive fetched by other means
"""
_NEUROFLUID_EXAMPLES = """\
  splashbench download neurofluid SYNTHETIC                  WaterSphere, WaterCube and HoneyCone
  splashbench download neurofluid WaterSphere SYNTHETIC      one of them
  splashbench download neurofluid SYNTHETIC --from part1.zip part2.zip    what a browser fetched
"""
_EXAMPLES = f"examples:\n{_LPIPS_EXAMPLES}{_SCENES_EXAMPLES}{_NEUROFLUID_EXAMPLES}"

_LPIPS = """
AlexNet's weights come from torchvision (alexnet-owt-7be5be79.pth, 244 MB) and the linear weights from the authors of
LPIPS (alex.pth, 6 kB). Nothing in them is run; what is needed of them is verified and stays as one .npz of 10 MB. It
lies in the folder SPLASHBENCH_CACHE, else XDG_CACHE_HOME/splashbench, else ~/.cache/splashbench, where `score` and
`study` find it. An interrupted download goes on where it stopped. Proxies are taken from https_proxy.
"""

_SCENES = """
The archive lies on a public drive (data_manifest/archive.json; CC BY 4.0). An interrupted download goes on where it
stopped, and scenes that are there stay. Its authors publish no checksum: size and SHA-256 are noted beside it when it
first comes (real_scene.zip.json) and verified after. The archive stays in DIR; remove it when you have what you need.
Unpacked is what the known layout holds: DIR/real_scene, DIR/real_scene_crop, DIR/meshes with scans of containers. Every
scene is checked, and a status of 1 says that one has a fault. Times come from Table S1 of the paper.
Where the drive refuses, as it does after many downloads, open its address in a browser, and give the file by --from.
NeuroFluid's scenes are fetched by `splashbench download neurofluid`.
"""

_NEUROFLUID = """
The authors of NeuroFluid share a folder of a public drive (data_manifest/neurofluid.json); they state no licence. How
the scenes lie in it is not documented. So every file that may belong to a wanted scene is fetched into DIR/neurofluid,
and what has the layout of these scenes is unpacked to DIR/NAME: from folders and zip archives. Nothing else is,
pickles above all. Size and SHA-256 of each file are noted in DIR/neurofluid.json when it first comes, and verified
after. An interrupted download goes on where it stopped, and scenes that are there stay. A status of 1 says that a scene
has a fault. Where the drive refuses, fetch the scenes with a browser, and give folders or archives by --from.
"""


def register(subparsers: argparse._SubParsersAction) -> None:
    """Add the command to the parser."""
    actions = add_group(
        subparsers,
        "download",
        summary="fetch the weights of LPIPS and released scenes, once",
        description="Fetch public files that are needed and not ours to ship, once, and verify them.",
        epilog=_EXAMPLES,
    )
    parser = add_command(
        actions,
        "lpips-weights",
        lpips_weights,
        summary="the network weights of LPIPS; without them it is null",
        description="Fetch the network weights of the metric LPIPS. Where they are there and verified, do nothing.",
        epilog=f"examples:\n{_LPIPS_EXAMPLES}{_LPIPS}",
    )
    parser.add_argument("--to", type=Path, metavar="FOLDER", help="keep them here (default: the cache folder)")
    parser.add_argument(
        "--from",
        type=Path,
        dest="by_hand",
        metavar="FOLDER",
        help="take alexnet-owt-7be5be79.pth and alex.pth from this folder; no network is needed",
    )
    _register_scenes(actions)
    _register_neurofluid(actions)


def _register_scenes(actions: argparse._SubParsersAction) -> None:
    parser = add_command(
        actions,
        "scenes",
        scenes,
        summary="the paper's 20 real scenes, checked and with their times",
        description="Fetch the archive of the released scenes into DIR, unpack scenes (all 20 by default), check them.",
        epilog=f"examples:\n{_SCENES_EXAMPLES}{_SCENES}",
    )
    parser.add_argument("names", nargs="*", metavar="NAME", help="scenes, such as bowl_001 (default: all 20)")
    parser.add_argument("out", type=Path, metavar="DIR", help="folder of the archive and of the scenes; the last word")
    parser.add_argument(
        "--variant",
        nargs="+",
        choices=("full", "crop"),
        default=["crop"],
        help="photographs as recorded (3840x2160, with masks of the container), or cut to the container, which is what "
        "the protocol scores (default: crop)",
    )
    parser.add_argument(
        "--from", type=Path, dest="by_hand", metavar="FILE", help="take this archive; no network is needed"
    )
    parser.add_argument("--url", metavar="URL", help="fetch the archive from a copy at this address")
    parser.add_argument("--check", action="store_true", help="check scenes again that were checked before")


def _register_neurofluid(actions: argparse._SubParsersAction) -> None:
    parser = add_command(
        actions,
        "neurofluid",
        neurofluid,
        summary="NeuroFluid's synthetic scenes, checked",
        description="Fetch NeuroFluid's synthetic scenes into DIR (all three by default), unpack and check them.",
        epilog=f"examples:\n{_NEUROFLUID_EXAMPLES}{_NEUROFLUID}",
    )
    parser.add_argument("names", nargs="*", metavar="NAME", help="WaterSphere, WaterCube, HoneyCone (default: all)")
    parser.add_argument("out", type=Path, metavar="DIR", help="folder of the scenes; the last word")
    parser.add_argument(
        "--from",
        type=Path,
        nargs="+",
        default=[],
        dest="by_hand",
        metavar="PATH",
        help="take these folders and zip archives; no network is needed",
    )
    parser.add_argument("--check", action="store_true", help="check scenes again that were checked before")


def lpips_weights(arguments: argparse.Namespace) -> int:
    """Handle `splashbench download lpips-weights`."""
    from splashbench.download.lpips_weights import download_lpips_weights
    from splashbench.score.image.weights import WEIGHTS_SHA256

    try:
        path, made = download_lpips_weights(arguments.to, arguments.by_hand, tell=say)
    except KeyboardInterrupt as error:
        return _interrupted(error)
    say(f"wrote {path}, verified" if made else f"{path} is there and verified; nothing to do")
    if arguments.to:
        say(f"score with --lpips-weights {path}, or set SPLASHBENCH_LPIPS_WEIGHTS to it")
    if arguments.json:
        emit({"weights": str(path), "sha256": WEIGHTS_SHA256, "made": made})
    return 0


def scenes(arguments: argparse.Namespace) -> int:
    """Handle `splashbench download scenes`."""
    from splashbench.download.archive import ArchiveSource, read_note
    from splashbench.download.scenes import download_scenes

    if arguments.url is not None and not arguments.url.startswith(("https://", "http://")):
        arguments.usage_error(f"--url {arguments.url!r} is no address of the web; a file is given by --from")
    source = ArchiveSource.official()
    if arguments.url is not None:
        source = source.mirrored(arguments.url)
    try:
        reports = download_scenes(
            arguments.out,
            arguments.names,
            arguments.variant,
            arguments.by_hand,
            tell=say,
            source=source,
            check_again=arguments.check,
        )
    except KeyboardInterrupt as error:
        return _interrupted(error)
    say(table(["scene", "variant", "frames", "seconds", "times from", "container"], [_row(each) for each in reports]))
    faulty = _say_faults(arguments.out, reports)
    if arguments.json:
        note = read_note(arguments.out, source)
        emit(
            {
                "out": str(arguments.out),
                "archive_bytes": note.bytes,
                "archive_sha256": note.sha256,
                "scenes": [_facts(report) for report in reports],
            }
        )
    return 1 if faulty else 0


def neurofluid(arguments: argparse.Namespace) -> int:
    """Handle `splashbench download neurofluid`."""
    from splashbench.download.neurofluid import download_neurofluid
    from splashbench.manifest import load_neurofluid

    # One word, or DIR behind --from, which takes it for one more source.
    if not arguments.names and str(arguments.out).lower() in [name.lower() for name in load_neurofluid().scenes]:
        arguments.usage_error(
            f"{arguments.out} is a scene; DIR comes behind the names, and before --from (a folder of this name: "
            f"{arguments.out.absolute()})"
        )
    try:
        reports = download_neurofluid(
            arguments.out, arguments.names, arguments.by_hand, tell=say, check_again=arguments.check
        )
    except KeyboardInterrupt as error:
        return _interrupted(error)
    rows = [[each.name, str(each.frames), f"{each.seconds:.2f}"] for each in reports]
    say(table(["scene", "frames", "seconds"], rows))
    faulty = _say_faults(arguments.out, reports)
    if arguments.json:
        emit({"out": str(arguments.out), "scenes": [_facts(report) for report in reports]})
    return 1 if faulty else 0


def _say_faults(out: Path, reports: list[SceneReport]) -> bool:
    """Tell the faults of scenes, and what to do next; returns whether there are any."""
    from splashbench.errors import one_line

    for report in reports:
        for fault in report.faults:
            say(f"error: {one_line(fault)}")
    faulty = [report for report in reports if report.faults]
    made = sum(report.made for report in reports)
    say(f"{len(reports)} scenes in {out}, {made} unpacked now, {len(faulty)} with faults")
    if faulty:
        say(f"error: {faulty[0].folder} has a fault, see above; remove that folder to unpack it again")
    else:
        say(f"run methods on them with: splashbench benchmark run OUT --scenes {out}")
    return bool(faulty)


def _row(report: SceneReport) -> list[str]:
    shown = {"manifest": "Table S1"}.get(report.times_source, report.times_source or "none")
    mesh = report.mesh.name if report.mesh else "from the footage"
    return [report.name, report.variant, str(report.frames), f"{report.seconds:.2f}", shown, mesh]


def _facts(report: SceneReport) -> dict[str, object]:
    return {
        "name": report.name,
        "variant": report.variant,
        "folder": str(report.folder),
        "made": report.made,
        "frames": report.frames,
        "times_source": report.times_source,
        "mesh": str(report.mesh) if report.mesh else None,
        "faults": report.faults,
    }


def _interrupted(error: KeyboardInterrupt) -> int:
    from splashbench.processes import Terminated

    say("\ninterrupted; the same command goes on where it stopped")
    return 128 + (error.signum if isinstance(error, Terminated) else signal.SIGINT)
