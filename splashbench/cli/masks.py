"""`splashbench masks compare|sheet`: compare two sets of masks as the paper does, or draw one for a person."""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterable
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from splashbench.cli.arguments import add_replace, whole_number
from splashbench.cli.command import add_command, add_group
from splashbench.cli.output import emit, say, table
from splashbench.errors import one_line

if TYPE_CHECKING:
    from splashbench.prepare.masks.comparison import MaskChange

_MASKS = "Masks are those of a scene (its seg/), or a folder of <camera>/<frame>.png, white where there is liquid.\n"

_COMPARE_EXAMPLES = """\
  splashbench masks compare sam3_masks scenes/bowl_001 --out comparison
  splashbench masks compare scenes_raw scenes_refined        a folder of scenes each: per scene and overall
"""

_SHEET_EXAMPLES = """\
  splashbench masks sheet scenes/bowl_001 --out sheet.png
  splashbench masks sheet sam3_masks --images frames --out sheet.png
"""

_MAX_COLUMNS = 40


def register(subparsers: argparse._SubParsersAction) -> None:
    """Add the command to the parser."""
    actions = add_group(
        subparsers,
        "masks",
        summary="compare liquid masks, or draw them for a person's eye",
        description="Compare two sets of liquid masks as the paper does, or draw a contact sheet of one.",
        epilog=f"examples:\n{_COMPARE_EXAMPLES}{_SHEET_EXAMPLES}\n{_MASKS}",
    )
    comparing = add_command(
        actions,
        "compare",
        compare,
        summary="compare raw with refined masks",
        description="Print mean and median IoU, the shares of the union added and removed, and the share of empty raw\n"
        "masks, per camera, per scene and overall.",
        epilog=f"examples:\n{_COMPARE_EXAMPLES}\n{_MASKS}A frame without a file has no liquid.\n",
    )
    comparing.add_argument("raw", type=Path, metavar="RAW", help="scene, folder of masks, or folder of either")
    comparing.add_argument("refined", type=Path, metavar="REFINED", help="the same, to compare with")
    comparing.add_argument(
        "--out", type=Path, metavar="DIR", help="write masks.csv, summary.csv and a picture per scene into this folder"
    )
    drawing = add_command(
        actions,
        "sheet",
        sheet,
        summary="draw a contact sheet to judge masks by eye",
        description="Draw outlines on the images, cameras in rows and timesteps in columns. A mask that is empty or\n"
        "cannot be right has a red frame and the reason.",
        epilog=f"examples:\n{_SHEET_EXAMPLES}\n{_MASKS}",
    )
    drawing.add_argument("masks", type=Path, metavar="SCENE_OR_FOLDER", help="scene, or folder of masks")
    drawing.add_argument("--out", type=Path, metavar="SHEET.png", required=True, help="the picture to be written")
    drawing.add_argument(
        "--images", type=Path, metavar="FOLDER", help="<camera>/<frame>.png or .jpg; default: the scene's, else black"
    )
    drawing.add_argument(
        "--columns", type=whole_number(1, _MAX_COLUMNS), default=8, metavar="N", help="timesteps to show (default: 8)"
    )
    add_replace(drawing, "SHEET.png")


def compare(arguments: argparse.Namespace) -> int:
    """Handle `splashbench masks compare`."""
    from splashbench.files import files_together, require_folder_place, require_unsealed_place
    from splashbench.prepare.masks.comparison import change_rows, compare_folders

    if arguments.out is not None:
        require_folder_place(arguments.out)
        require_unsealed_place(arguments.out)
        _require_apart(arguments.out, (arguments.raw, arguments.refined))
    comparisons = list(compare_folders(arguments.raw, arguments.refined))
    rows = change_rows(comparisons)
    header = ["scene", "camera", "masks", "IoU mean", "median", "added", "removed", "raw empty", "touched", "coverage"]
    print_table = print if not arguments.json else say
    print_table(table(header, [_row(*key, change) for key, change in rows.items()]))
    if arguments.out is not None:
        from splashbench.prepare.masks.comparison_report import write_report

        with files_together(arguments.out) as staging:
            names = write_report(comparisons, rows, staging)
        say(f"wrote {', '.join(names)} in {arguments.out}")
    if arguments.json:
        figures = [
            {
                "scene": scene,
                "camera": camera,
                **{key: None if math.isnan(value) else value for key, value in asdict(change).items()},
            }
            for (scene, camera), change in rows.items()
        ]
        emit({"raw": str(arguments.raw), "refined": str(arguments.refined), "rows": figures})
    return 0


def _require_apart(out: Path, inputs: Iterable[Path | None]) -> None:
    """Raise SplashbenchError where an output would lie among the masks or images that are read."""
    from splashbench.errors import SplashbenchError

    for source in inputs:
        if source is not None and out.resolve().is_relative_to(source.resolve()):
            raise SplashbenchError(f"{out} lies in {source}, which is read; give another place for the output")


def _row(scene: str, camera: str, change: MaskChange) -> list[str]:
    def share(value: float, digits: int = 1) -> str:
        return "-" if math.isnan(value) else f"{value:.{digits}%}"

    def figure(value: float) -> str:
        return "-" if math.isnan(value) else f"{value:.3f}"

    return [
        one_line(scene),
        one_line(camera),
        str(change.n_masks),
        figure(change.mean_iou),
        figure(change.median_iou),
        share(change.added_share),
        share(change.removed_share),
        share(change.empty_share),
        share(change.touched_share, 2),
        f"{share(change.raw_coverage, 2)} to {share(change.refined_coverage, 2)}",
    ]


def sheet(arguments: argparse.Namespace) -> int:
    """Handle `splashbench masks sheet`."""
    from splashbench.errors import SplashbenchError
    from splashbench.files import require_file_place, write_png
    from splashbench.prepare.masks.comparison import find_mask_sets
    from splashbench.prepare.masks.sheet import sheet_of_set

    if arguments.out.suffix.lower() != ".png":
        raise SplashbenchError(f"{arguments.out} does not end in .png; name the picture so")
    require_file_place(arguments.out)
    _require_apart(arguments.out, (arguments.masks, arguments.images))
    if arguments.out.exists() and not arguments.replace:
        raise SplashbenchError(f"{arguments.out} exists already; give another name, or --replace to replace it")
    if arguments.images is not None and not arguments.images.is_dir():
        raise SplashbenchError(f"{arguments.images} is not a folder; give that of <camera>/<frame>.png or .jpg")
    sets = find_mask_sets(arguments.masks)
    if len(sets) > 1:
        raise SplashbenchError(f"{arguments.masks} holds {len(sets)} scenes; give one, such as {sets[0].folder}")
    picture, faults, remarks = sheet_of_set(sets[0], arguments.columns, arguments.images)
    write_png(arguments.out, picture)
    for remark in remarks:
        say(f"note: {remark}")
    for camera, reasons in faults.items():
        for t, reason in reasons.items():
            say(f"camera {camera}, frame {t}: {reason}")
    say(f"wrote {arguments.out}: {sum(map(len, faults.values()))} masks empty or failed")
    if arguments.json:
        fault_lists = {camera: {str(t): reason for t, reason in reasons.items()} for camera, reasons in faults.items()}
        emit({"sheet": str(arguments.out), "faults": fault_lists, "notes": remarks})
    return 0
