"""`splashbench download`: fetch what is needed and not ours to ship, once: LPIPS weights, released scenes."""

from __future__ import annotations

import argparse
import signal
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

from splashbench.cli.command import add_command, add_group
from splashbench.cli.output import emit, say, table

if TYPE_CHECKING:
    from splashbench.download.containers import ContainerReport, MaskReport
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
  splashbench download scenes REAL --variant full crop --container-masks   and these cut to the crops
  splashbench download scenes REAL --variant full crop --containers    the container's mesh put in its place, too
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
With --container-masks crops get the masks of the container that the release has beside the whole images alone.
With --containers every scene gets the mesh of its container: its scan placed by the container masks of the full variant
(as `splashbench scene place-container` does, with gravity and scale), else a surface from the footage of an opaque one
(as `splashbench scene reconstruct-container`). Where that is refused a line says why, and the rest goes on; a status of
1 says that a scan was not placed. A method is then told more: its results are ranked in a group of their own, and a
scene that had been run before has another digest. What is there stays; the same command tries again what was refused.
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
    parser.add_argument(
        "--container-masks",
        action="store_true",
        help="cut the full variant's container masks to the crops, which the release leaves without; methods are told "
        "them then, and are ranked in another group (default: crops as released)",
    )
    parser.add_argument(
        "--containers",
        action="store_true",
        help="put every container's mesh in its place, from its scan or else the footage; methods are told more then, "
        "and are ranked in another group (default: scenes as released)",
    )


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
    from splashbench.download.containers import add_container_masks, add_containers
    from splashbench.download.scenes import download_scenes
    from splashbench.manifest import load_scenes

    if arguments.url is not None and not arguments.url.startswith(("https://", "http://")):
        arguments.usage_error(f"--url {arguments.url!r} is no address of the web; a file is given by --from")
    # One word, or DIR behind --from, which takes it for one more source; nothing is fetched into a folder of that name.
    if str(arguments.out).lower() in map(str.lower, load_scenes()) and not arguments.out.is_dir():
        _without_folder(arguments)
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
        masks = (
            add_container_masks(arguments.out, reports, tell=say, source=source) if arguments.container_masks else []
        )
        containers = (
            add_containers(arguments.out, reports, _Maker(), tell=say, source=source) if arguments.containers else []
        )
    except KeyboardInterrupt as error:
        return _interrupted(error)
    shown = [_shown(each) for each in containers] or [_expected(each) for each in reports]
    rows = [[*_row(report), container] for report, container in zip(reports, shown)]
    say(table(["scene", "variant", "frames", "seconds", "times from", "container"], rows))
    unmasked = _say_masks(masks)
    unplaced = _say_containers(containers, reports)
    faulty = _say_faults(arguments.out, reports)
    if arguments.json:
        note = read_note(arguments.out, source)
        emit(
            {
                "out": str(arguments.out),
                "archive_bytes": note.bytes,
                "archive_sha256": note.sha256,
                "scenes": [_facts(report) for report in reports],
                "container_masks": [asdict(each) for each in masks] if arguments.container_masks else None,
                "containers": [_container_facts(each) for each in containers] if arguments.containers else None,
            }
        )
    return 1 if faulty or unmasked or unplaced else 0


class _Maker:
    """Places and reconstructs as the commands of `splashbench scene` do (`download.containers.ContainerMaker`)."""

    def place(self, scene: Path, scan: Path, masks: Path | None) -> list[str]:
        from splashbench.container.entry import doubtful, name_in_scene
        from splashbench.container.scene_placement import place_in_scene, require_container_place, write_placement
        from splashbench.files import sha256_file
        from splashbench.scene import Scene
        from splashbench.scene.container import read_mesh

        opened = Scene.open(scene)
        # A killed run may have moved the scan in, and not scene.json, which is last.
        copy = scene / name_in_scene(scan)
        if copy.is_file() and not copy.is_symlink() and sha256_file(copy) == sha256_file(scan):
            copy.unlink()
        require_container_place(opened, scan, replace=False)
        outcome = place_in_scene(opened, read_mesh(scan), None if masks is None else Scene.open(masks))
        write_placement(opened, scan, outcome)
        doubts = _little_overlap(doubtful(outcome.projections))
        if outcome.placement.up_is_ambiguous:
            doubts.append(f"the mesh fits with other directions up as well; {outcome.placement.up_axis} was chosen")
        return doubts

    def reconstruct(self, scene: Path, masks: Path | None) -> list[str]:
        from splashbench.container.entry import doubtful, require_place
        from splashbench.container.reconstruction import container_from_footage, write_reconstruction
        from splashbench.errors import SplashbenchError
        from splashbench.scene import Scene

        opened = Scene.open(scene)
        if opened.container_transparent:
            raise SplashbenchError(
                "scene.json says that it is transparent: it hides nothing, and its depth is not seen"
            )
        require_place(opened, replace=False)
        reconstruction = container_from_footage(opened, None if masks is None else Scene.open(masks))
        write_reconstruction(opened, reconstruction)
        doubts = _little_overlap(doubtful(reconstruction.projections))
        if opened.container_transparent is None:
            doubts.append("it was assumed to be opaque; a transparent one needs a scan")
        return doubts


def _little_overlap(cameras: list[str]) -> list[str]:
    return [f"little overlap of mesh and mask in camera {', '.join(cameras)}"] if cameras else []


def _without_folder(arguments: argparse.Namespace) -> NoReturn:
    """Say that DIR, which is the name of a scene, was left out."""
    arguments.usage_error(
        f"{arguments.out} is a scene; DIR comes behind the names, and before --from (a folder of this name: "
        f"{arguments.out.absolute()})"
    )
    raise AssertionError  # usage_error ends the program


def neurofluid(arguments: argparse.Namespace) -> int:
    """Handle `splashbench download neurofluid`."""
    from splashbench.download.neurofluid import download_neurofluid
    from splashbench.manifest import load_neurofluid

    # One word, or DIR behind --from, which takes it for one more source.
    if not arguments.names and str(arguments.out).lower() in [name.lower() for name in load_neurofluid().scenes]:
        _without_folder(arguments)
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


def _say_masks(masks: list[MaskReport]) -> bool:
    """Tell which scenes have container masks now; returns whether some have none."""
    from splashbench.errors import one_line

    missing = [each for each in masks if not each.count]
    for each in missing:
        say(f"error: no container masks in {each.scene}: {one_line(each.reason)}")
    if masks:
        made = sum(each.made for each in masks)
        already = len(masks) - made - len(missing)
        say(f"container masks: cut for {made} scenes now, there already in {already}, missing in {len(missing)}")
    return bool(missing)


def _say_containers(containers: list[ContainerReport], reports: list[SceneReport]) -> bool:
    """Tell what is doubtful of containers and which are missing; returns whether a scan was not placed."""
    from splashbench.errors import one_line

    for container, report in zip(containers, reports):
        for doubt in container.doubts:
            say(f"note: container of {container.scene}: {doubt}")
        # A damaged scan is told among the scene's faults.
        if container.file is None and container.reason not in report.faults:
            what = "note: no container in" if container.scan is None else "error: the scan is not placed in"
            say(f"{what} {container.scene}: {one_line(container.reason)}; by hand: {container.by_hand}")
    if containers:
        made, missing = sum(each.made for each in containers), sum(each.file is None for each in containers)
        already = len(containers) - made - missing
        say(f"containers: {made} put in their places now, {already} that were there already, {missing} missing")
    return any(each.file is None and each.scan is not None for each in containers)


def _row(report: SceneReport) -> list[str]:
    shown = {"manifest": "Table S1"}.get(report.times_source, report.times_source or "none")
    return [report.name, report.variant, str(report.frames), f"{report.seconds:.2f}", shown]


def _expected(report: SceneReport) -> str:
    return report.mesh.name if report.mesh else "from the footage"


def _shown(container: ContainerReport) -> str:
    if container.file is None:
        return "none"
    return container.file if container.made else f"already {container.file}"


def _container_facts(container: ContainerReport) -> dict[str, object]:
    return {
        "scene": container.scene,
        "file": container.file,
        "made": container.made,
        "scan": str(container.scan) if container.scan else None,
        "reason": container.reason or None,
        "by_hand": container.by_hand or None,
        "doubts": container.doubts,
    }


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
