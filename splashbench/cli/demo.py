"""`splashbench demo OUT`: the whole road once, on a made-up pour with exact ground truth.

Every step is an ordinary command, printed before it runs, so that a newcomer can type it again. Steps whose output is
there already are kept: each output is written whole or not at all, so what exists is complete.
"""

from __future__ import annotations

import argparse
import shlex
import time
from pathlib import Path

from splashbench.cli.output import add_json, emit, say, table

_EPILOG = """\
example:
  splashbench demo demo_output

About ten minutes on two cores. Look at demo_output/README.txt afterwards.
"""

#: id, preset and further options of the runs; the oracle is written by the harness.
_RUNS = (
    ("nothing", ["--preset", "quick"]),
    ("nearest_camera", []),
    ("oracle", []),
    ("splashsplat", ["--preset", "quick"]),
)


def register(subparsers: argparse._SubParsersAction) -> None:
    """Add the command to the parser."""
    parser = subparsers.add_parser(
        "demo",
        help="the whole road once: film, prepare, reconstruct, score, chart",
        description="Make up a recording of a pour, prepare it, reconstruct it, score it and draw the leaderboard.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("out", type=Path, help="folder for everything the demo makes")
    parser.add_argument("--seed", type=int, default=0, help="seed of the made-up pour and of the methods")
    parser.add_argument("--fresh", action="store_true", help="make everything anew, also what is there already")
    add_json(parser)
    parser.set_defaults(handler=run)


def run(arguments: argparse.Namespace) -> int:
    """Handle `splashbench demo`."""
    from splashbench.files import write_text

    start = time.monotonic()
    out: Path = arguments.out
    seed = ["--seed", str(arguments.seed)]
    steps = _Steps(arguments.fresh)
    session, scene, runs, results = out / "session", out / "scene", out / "submissions", out / "results"

    steps.run("film a made-up pour", session, ["synth", "session", str(session), *seed])
    # What follows a step made anew must be made anew too.
    steps.run("prepare the scene", scene, ["prepare", str(session), str(scene)])
    steps.run(
        "compare it with the truth", out / "verify.json",
        ["synth", "verify", str(session), str(scene), "--out", str(out / "verify.json")],
    )
    for name, options in _RUNS:
        extra = [] if name == "oracle" else [*options, *seed]
        steps.run(f"run {name}", runs / name, ["run", name, str(scene), str(runs / name), *extra])
    for name, _ in _RUNS:
        steps.always(f"check {name}", ["check", str(runs / name), "--scene", str(scene)])
    steps.run(
        "score them", results,
        ["score", *(str(runs / name) for name, _ in _RUNS), "--scene", str(scene), "--out", str(results),
         "--reference", str(runs / "nothing"), "--sheet", str(out / "contact_sheet.png")],
    )
    steps.always("draw the leaderboard", ["leaderboard", str(results), str(out / "leaderboard"), "--replace"])

    summary = _summary(out, results, time.monotonic() - start)
    write_text(out / "README.txt", summary["text"])
    say()
    say(summary["text"])
    if arguments.json:
        emit({key: value for key, value in summary.items() if key != "text"})
    return 0 if summary["passed"] else 1


class _Steps:
    """Runs commands in order; once one was run afresh, everything after it is too."""

    def __init__(self, fresh: bool) -> None:
        self._fresh = fresh
        self._count = 0

    def run(self, title: str, output: Path, command: list[str]) -> None:
        """Run `command` unless its whole output is there and nothing before it has changed."""
        if output.exists() and not self._fresh:
            self._count += 1
            say(f"[{self._count}] {title}: found {output}, kept")
            return
        if output.exists():
            command = [*command, "--replace"]
        self._fresh = True
        self.always(title, command)

    def always(self, title: str, command: list[str]) -> None:
        """Run `command`; its failure ends the demo."""
        from splashbench.cli.main import build_parser
        from splashbench.errors import SplashbenchError

        self._count += 1
        say(f"\n[{self._count}] {title}\n    $ splashbench {shlex.join(command)}")
        start = time.monotonic()
        parsed = build_parser().parse_args(command)
        if parsed.handler(parsed) != 0:
            raise SplashbenchError(f"the demo stopped at: splashbench {shlex.join(command)}; see the lines above")
        say(f"    {time.monotonic() - start:.1f} s")


def _summary(out: Path, results: Path, seconds: float) -> dict:
    """What came out, whether it is what the demo promises, and where to look."""
    from splashbench.files import read_json
    from splashbench.score.result import Result

    verify = read_json(out / "verify.json")
    found = [Result.read(path) for path in sorted(results.glob("*.json"))]
    scores = {result.method: result.values() for result in found}
    gates = [
        ("largest sync error, ms", verify["sync_error_ms_max"], 1.0, True),
        ("largest focal error, %", verify["focal_error_percent_max"], 1.0, True),
        ("cameras posed", verify["cameras_posed"], 7, False),
        ("mean rotation error, degrees", verify["rotation_error_deg_mean"], 0.2, True),
        ("splashsplat PSNR over nothing, dB", scores["splashsplat"]["dpsnr_bg"], 1.0, False),
        ("splashsplat mIoU", scores["splashsplat"]["miou"], 0.6, False),
        ("oracle PSNR, dB", scores["oracle"]["psnr"], 100.0, False),
        ("oracle SSIM", scores["oracle"]["ssim"], 1.0, False),
        ("oracle mIoU", scores["oracle"]["miou"], 1.0, False),
    ]
    rows, passed = [], True
    for name, value, limit, at_most in gates:
        good = value is not None and (value <= limit if at_most else value >= limit)
        passed &= good
        shown = "none" if value is None else f"{value:.4g}"
        rows.append([name, shown, f"{'<=' if at_most else '>='} {limit:g}", "pass" if good else "FAIL"])
    text = "\n".join(
        [
            f"splashbench demo, {seconds / 60:.1f} minutes in this run",
            "",
            table(["what", "value", "wanted", ""], rows),
            "",
            "look at",
            f"  {out / 'contact_sheet.png'}    truth, renders and foreground opacity at the test views",
            f"  {out / 'leaderboard'}    leaderboard.md, leaderboard.csv and the speed-against-accuracy chart",
            f"  {out / 'scene' / 'prepare_report.html'}    how the recording became a scene, with every check",
            "",
        ]
    )
    return {
        "passed": passed,
        "seconds": seconds,
        "gates": [{"name": row[0], "value": gate[1], "wanted": row[2], "passed": row[3] == "pass"}
                  for row, gate in zip(rows, gates)],
        "text": text,
    }
