"""`splashbench score SUBMISSION... --scene SCENE --out DIR`: one result per submission."""

from __future__ import annotations

import argparse
import difflib
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from splashbench.cli.arguments import add_lpips_weights, add_settings
from splashbench.cli.command import add_command
from splashbench.cli.output import emit, say, table
from splashbench.cli.verification import verify_results

if TYPE_CHECKING:
    from splashbench.score import Protocol, Result

_EPILOG = """\
examples:
  splashbench score runs/bowl_001/splashsplat --scene scenes/bowl_001 --out results
  splashbench score runs/bowl_001/* --scene scenes/bowl_001 --out results --reference runs/bowl_001/nothing
  splashbench score --verify results/*.json --scene scenes/bowl_001 --submissions runs    do these results hold?

Beside each result lie its pictures (.jpg), which the leaderboard's page shows. A run with checkpoints has them scored.
Ground truth comes from SCENE alone. A failed run becomes a result with its status and without scores. --reference
takes the submission of the control `nothing` on the same scene and gives dpsnr_bg and spill_rgb. LPIPS needs weights,
else it is null: `splashbench download lpips-weights` fetches them once. Before those come --lpips-weights and the
environment variable SPLASHBENCH_LPIPS_WEIGHTS, after them an installed lpips package with torchvision's AlexNet cached.
Where a synthetic SCENE has true particles, geometry and motion are compared with them.
With --verify the arguments are results: their submissions, beside them or in --submissions, are scored again.
"""

# Columns of the printed table; a result has every metric. Those against true particles have a table of their own.
_SHOWN = ("psnr", "dpsnr_bg", "ssim", "lpips", "miou", "spill", "jitter_error", "uniformity", "delta_e", "fit_seconds")


def register(subparsers: argparse._SubParsersAction) -> None:
    """Add the command to the parser."""
    parser = add_command(
        subparsers,
        "score",
        run,
        summary="score submissions by protocol v1",
        description="Score each SUBMISSION against SCENE and write one result (JSON) for each into DIR.",
        epilog=_EPILOG,
    )
    parser.add_argument("submissions", nargs="+", type=Path, metavar="SUBMISSION", help="folder of a submission")
    parser.add_argument("--scene", type=Path, required=True, help="folder of the scene the submissions are of")
    parser.add_argument(
        "--out", type=Path, metavar="DIR", help="folder the results are written into; required but for --verify"
    )
    parser.add_argument(
        "--verify", action="store_true", help="verify results (.json) in the place of submissions; nothing is written"
    )
    parser.add_argument(
        "--submissions",
        dest="look_in",
        type=Path,
        nargs="+",
        default=[],
        metavar="FOLDER",
        help="with --verify: where submissions are, besides the results' own folder",
    )
    parser.add_argument("--reference", type=Path, metavar="SUBMISSION", help="the control `nothing` on this scene")
    add_lpips_weights(parser)
    parser.add_argument("--sheet", type=Path, metavar="PNG", help="also draw a contact sheet of all submissions")
    add_settings(parser, "change a setting of the protocol; such results are kept apart from v1's", dest="changes")


def run(arguments: argparse.Namespace) -> int:
    """Handle `splashbench score`."""
    from splashbench.files import require_folder_place, require_picture_place, require_unsealed_place
    from splashbench.report.result_sheet import write_result_sheet
    from splashbench.scene import Scene
    from splashbench.score import score_submission, shared_fields
    from splashbench.submission import Submission

    if arguments.verify:
        for flag, given in (("--out", arguments.out), ("--sheet", arguments.sheet), ("--set", arguments.changes)):
            if given:
                arguments.usage_error(f"{flag} is not for --verify, which writes nothing; leave it out")
        return verify_results(arguments)
    if arguments.out is None:
        arguments.usage_error("the following arguments are required: --out")
    if arguments.look_in:
        arguments.usage_error("--submissions is for --verify; add it")
    protocol = _protocol(arguments.changes)
    require_folder_place(arguments.out)
    require_unsealed_place(arguments.out)
    if arguments.sheet:
        require_picture_place(arguments.sheet, arguments.scene)
    scene = Scene.open(arguments.scene)
    # All are opened, hence verified, first: scoring may take hours.
    submissions = [Submission.open(path) for path in arguments.submissions]
    reference = Submission.open(arguments.reference) if arguments.reference else None
    fields = shared_fields(scene, protocol)
    results, files = [], []
    for path, submission in zip(arguments.submissions, submissions):
        say(f"{path}: {submission.identity.method} on {scene.name}")
        result = score_submission(
            scene, submission, reference, arguments.lpips_weights, protocol=protocol, fields=fields
        )
        results.append(result)
        saved = result.save(arguments.out)
        files.append(str(saved))
        if result.status == "ok":
            write_result_sheet(scene, submission, saved)
    if arguments.sheet:
        from splashbench.report.contact_sheet import contact_sheet

        contact_sheet(scene, submissions, arguments.sheet)
    say(_summary(results))
    for file in files:
        say(f"wrote {file}")
    if arguments.json:
        emit(
            {
                "scene": scene.name,
                "protocol": protocol.label,
                "results": [
                    {"file": file, "method": r.method, "preset": r.preset, "seed": r.seed, "status": r.status}
                    | {"reason": r.reason, "metrics": {name: metric.value for name, metric in r.metrics.items()}}
                    for file, r in zip(files, results)
                ],
            }
        )
    return 0


def _protocol(changes: list[str]) -> Protocol:
    """Protocol v1 with the changes KEY=VALUE. Raises SplashbenchError for a setting that it does not have."""
    from pydantic import ValidationError

    from splashbench.errors import SplashbenchError
    from splashbench.score import Protocol

    values = {}
    names = ", ".join(Protocol.model_fields)
    for change in changes:
        key, separator, value = change.partition("=")
        if not separator or not key:
            raise SplashbenchError(f"--set {change!r} is not KEY=VALUE; there are {names}")
        if key not in Protocol.model_fields:
            near = difflib.get_close_matches(key, Protocol.model_fields, n=1)
            hint = f"did you mean {near[0]!r}?" if near else f"there are {names}"
            raise SplashbenchError(f"--set {key}: the protocol has no such setting; {hint}")
        values[key] = value
    try:
        return Protocol.model_validate(values)
    except ValidationError as error:
        first = error.errors()[0]
        raise SplashbenchError(f"--set {first['loc'][0]}: {first['msg']}") from None


def _summary(results: list[Result]) -> str:
    from splashbench.errors import one_line
    from splashbench.score import METRICS
    from splashbench.score.metrics import TRUTH_METRICS
    from splashbench.score.notation import FILTER_NOTE

    lines = [_figures(results, _SHOWN)]
    with_truth = [result for result in results if result.digests.truth is not None]
    if with_truth:
        lines += ["against the true particles:", _figures(with_truth, TRUTH_METRICS)]
    if any(result.mixed and result.status == "ok" for result in results):
        lines.append(FILTER_NOTE)
    missing = {
        f"{name}: {metric.reason}"
        for result in results
        if result.status == "ok"
        for name, metric in result.metrics.items()
        if metric.value is None and METRICS[name].group != "cost"
        if name not in TRUTH_METRICS or result.digests.truth is not None
    }
    lines += [f"null {reason}" for reason in sorted(missing)]
    lines += [
        f"{result.method} failed: {one_line(result.reason) or result.status}"
        for result in results
        if result.status != "ok"
    ]
    return "\n".join(lines)


def _figures(results: list[Result], names: Sequence[str]) -> str:
    """A table with a row per result and a column per metric of `names`."""
    from splashbench.score import METRICS
    from splashbench.score.notation import filter_mark, label, stored

    rows = []
    for result in results:
        figures = {name: result.value(name) for name in names}
        cells = [
            stored(name, value, "-") + filter_mark(METRICS[name], result.mixed, value)
            for name, value in figures.items()
        ]
        rows.append([result.method, str(result.seed), result.status, *cells])
    return table(["method", "seed", "status", *(label(METRICS[name]) for name in names)], rows)
