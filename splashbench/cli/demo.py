"""`splashbench demo OUT`: every step once, on a synthetic pour with exact ground truth.

Every step is an ordinary command and is printed before it runs, so that a newcomer can type it again. A step whose
output exists is skipped: outputs are written whole or not at all, so what exists is complete.
"""

from __future__ import annotations

import argparse
import shlex
import shutil
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean

from splashbench.cli.arguments import add_seed
from splashbench.cli.command import add_command
from splashbench.cli.output import emit, say, table

_EPILOG = """\
example:
  splashbench demo demo_output

Takes about six minutes on two shared cores. Read demo_output/README.txt afterwards.
"""

#: Marks the folder of a demo, finished or not.
_MARK = ".splashbench_demo"
_MARK_BYTES = 4096

#: id, preset and further options of the runs; the oracle is written by the harness.
_RUNS: tuple[tuple[str, list[str]], ...] = (
    ("nothing", ["--preset", "quick"]),
    ("nearest_camera", []),
    ("oracle", []),
    ("hull_points", []),
    ("splashsplat", ["--preset", "quick"]),
)


def register(subparsers: argparse._SubParsersAction) -> None:
    """Add the command to the parser."""
    parser = add_command(
        subparsers,
        "demo",
        run,
        summary="every step once on a synthetic pour: film, prepare, reconstruct, score, chart, video",
        description="Film a synthetic pour, prepare it, reconstruct it, score it, draw the leaderboard and a video.",
        epilog=_EPILOG,
    )
    parser.add_argument("out", type=Path, metavar="OUT", help="folder for everything the demo makes")
    add_seed(parser, "seed of the synthetic pour and of the methods")
    parser.add_argument("--fresh", action="store_true", help="make everything again, existing outputs included")


def run(arguments: argparse.Namespace) -> int:
    """Handle `splashbench demo`."""
    from splashbench.files import write_text

    start = time.monotonic()
    out: Path = arguments.out
    seed = ["--seed", str(arguments.seed)]
    session, scene, truth, results = out / "session", out / "scene", out / "verify.json", out / "results"
    sheet, leaderboard = out / "contact_sheet.png", out / "leaderboard"
    video, summary = out / "splashsplat.mp4", out / "README.txt"
    runs = {name: out / "submissions" / name for name, _ in _RUNS}

    # The contact sheet is what scoring writes last: where it is, the results are whole.
    steps = _Steps([session, scene, truth, *runs.values(), sheet, results, leaderboard, video, summary])
    _claim(out, arguments.seed, steps if arguments.fresh else None)
    steps.run("film a synthetic pour", session, ["synth", "session", str(session), *seed])
    steps.run("prepare the scene", scene, ["prepare", str(session), str(scene)])
    steps.run("compare it with the truth", truth, ["synth", "verify", str(session), str(scene), "--out", str(truth)])
    for name, options in _RUNS:
        options = options if name == "oracle" else [*options, *seed]
        steps.run(f"run {name}", runs[name], ["run", name, str(scene), str(runs[name]), *options])
    for name, directory in runs.items():
        steps.always(f"check {name}", ["check", str(directory), "--scene", str(scene)])
    steps.run(
        "score them",
        sheet,
        [
            *("score", *map(str, runs.values()), "--scene", str(scene), "--out", str(results)),
            *("--reference", str(runs["nothing"]), "--sheet", str(sheet)),
        ],
    )
    steps.always("draw the leaderboard", ["leaderboard", str(results), str(leaderboard)])
    shown = str(runs["splashsplat"])
    steps.run(
        "show splashsplat beside the truth at half speed",
        video,
        ["video", shown, str(video), "--scene", str(scene), "--beside", "truth", "--slow", "2"],
    )

    gates = _gates(truth, results)
    text = _summary(out, gates, time.monotonic() - start)
    write_text(summary, text)
    say(f"\n{text}")
    if arguments.json:
        emit({"out": str(out), "passed": all(gate.passed for gate in gates), "gates": [vars(gate) for gate in gates]})
    return 0 if all(gate.passed for gate in gates) else 1


def _claim(out: Path, seed: int, fresh: _Steps | None) -> None:
    """Mark `out` as the demo's own: it removes outputs that it makes again, so it must never take another folder.

    fresh: steps whose outputs are removed before the mark names this demo, so that it speaks of all that lies there.
    Raises SplashbenchError for a folder of something else, and without `fresh` for a demo of another seed or version:
    its outputs would be skipped, and their figures shown as those of this one.
    """
    from splashbench.errors import SplashbenchError, one_line
    from splashbench.files import read_plain, require_folder_place, write_text

    require_folder_place(out)
    mark = out / _MARK
    if out.is_dir() and any(out.iterdir()) and not mark.is_file():
        raise SplashbenchError(f"{out} holds files that are not the demo's; give a new or an empty folder")
    text = "Made by `splashbench demo`, which may replace everything here.\n"
    if mark.is_file() and fresh is None:
        made_by = read_plain(mark, _MARK_BYTES).decode("utf-8", "replace").partition("\n")[2].strip()
        if made_by != _made_by(seed):
            was = made_by or "an earlier version"
            raise SplashbenchError(
                f"{out} holds the demo of {one_line(was)}, and this is {_made_by(seed)}; add --fresh to make all of it "
                "again, or give another folder"
            )
    if fresh is not None and mark.is_file():
        write_text(mark, text + "a run that was stopped while it removed outputs\n")
        fresh.forget(0)
    write_text(mark, f"{text}{_made_by(seed)}\n")


def _made_by(seed: int) -> str:
    from splashbench.harness.discovery import load_method
    from splashbench.version import __version__

    return f"seed {seed}, splashbench {__version__}, splashsplat {load_method('splashsplat').version}"


class _Steps:
    """Runs commands in order. outputs: what they make, in this order; later ones are made from earlier ones."""

    def __init__(self, outputs: Sequence[Path]) -> None:
        self._outputs = outputs
        self._count = 0

    def run(self, title: str, output: Path, command: list[str]) -> None:
        """Run `command` unless its `output` exists.

        All later outputs are removed first: were the demo stopped, they would be taken for what it makes next time.
        """
        if output.exists():
            self._count += 1
            say(f"\n[{self._count}] {title}: skipped, {output} exists")
            return
        self.forget(self._outputs.index(output))
        self.always(title, command)

    def forget(self, first: int) -> None:
        """Remove the outputs from number `first` on: they are the demo's own, from an earlier run."""
        for path in self._outputs[first:]:
            # Loudly: what could not be removed would be skipped as if it had been made again.
            if path.is_dir() and not path.is_symlink():
                shutil.rmtree(path)
            else:
                path.unlink(missing_ok=True)

    def always(self, title: str, command: list[str]) -> None:
        """Run `command`; its failure ends the demo."""
        from splashbench.cli.main import run_within
        from splashbench.errors import SplashbenchError

        self._count += 1
        say(f"\n[{self._count}] {title}\n    $ splashbench {shlex.join(command)}")
        start = time.monotonic()
        if run_within(command) != 0:
            raise SplashbenchError(f"the demo stopped at: splashbench {shlex.join(command)}; see the lines above")
        say(f"    {time.monotonic() - start:.1f} s")


@dataclass
class _Gate:
    """A figure that the demo promises, with its limit."""

    name: str
    value: float | None
    limit: float
    at_most: bool

    @property
    def passed(self) -> bool:
        if self.value is None:
            return False
        return self.value <= self.limit if self.at_most else self.value >= self.limit

    def row(self) -> list[str]:
        """The gate as a line of the summary."""
        shown = "none" if self.value is None else f"{self.value:.4g}"
        return [self.name, shown, f"{'<=' if self.at_most else '>='} {self.limit:g}", "pass" if self.passed else "FAIL"]


def _gates(truth: Path, results: Path) -> list[_Gate]:
    """The figures that the demo promises, with their limits."""
    from splashbench.files import read_json
    from splashbench.score.result import Result

    cameras = read_json(truth)["cameras"].values()
    scores = {result.method: result for result in map(Result.load, sorted(results.glob("*.json")))}
    return [
        _Gate("largest sync error, ms", max(abs(camera["sync_error_ms"]) for camera in cameras), 1.0, True),
        _Gate("largest focal error, %", max(abs(camera["focal_error_percent"]) for camera in cameras), 1.0, True),
        _Gate("cameras posed", len(cameras), 7, False),
        _Gate("mean rotation error, degrees", fmean(camera["rotation_error_deg"] for camera in cameras), 0.2, True),
        _Gate("splashsplat, PSNR over nothing, dB", scores["splashsplat"].value("dpsnr_bg"), 1.0, False),
        _Gate("splashsplat, mIoU", scores["splashsplat"].value("miou"), 0.6, False),
        _Gate("oracle, PSNR, dB", scores["oracle"].value("psnr"), 100.0, False),
        _Gate("oracle, SSIM", scores["oracle"].value("ssim"), 1.0, False),
        _Gate("oracle, mIoU", scores["oracle"].value("miou"), 1.0, False),
    ]


def _summary(out: Path, gates: list[_Gate], seconds: float) -> str:
    """The text of README.txt: the figures, and where to look."""
    return "\n".join(
        [
            f"splashbench demo, {seconds / 60:.1f} minutes in this run",
            "",
            table(["check", "value", "limit", ""], [gate.row() for gate in gates]),
            "",
            "look at",
            f"  {out / 'splashsplat.mp4'}    the reconstruction beside the truth at half speed",
            f"  {out / 'contact_sheet.png'}    truth, renders and foreground opacity at the test views",
            f"  {out / 'leaderboard' / 'index.html'}    the figures as a page, with charts; tables lie beside it",
            f"  {out / 'scene' / 'prepare_report.html'}    how the recording became a scene, with every check",
            "",
        ]
    )
