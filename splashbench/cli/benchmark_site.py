"""`splashbench benchmark init | check | site`: a public leaderboard from a git repository of results."""

from __future__ import annotations

import argparse
import shutil
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

from splashbench.cli.arguments import add_lpips_weights
from splashbench.cli.command import add_command
from splashbench.cli.output import emit, say

if TYPE_CHECKING:
    from splashbench.benchmark.repository import Benchmark, Entry

_INIT = """\
  splashbench benchmark init BENCHMARK                                  a benchmark of the 20 released scenes
  splashbench benchmark init BENCHMARK --title "Pours" --scenes SCENES  of scenes of your own
  splashbench benchmark init BENCHMARK --install git+https://HOST/PATH@TAG
"""
_CHECK = """\
  splashbench benchmark check BENCHMARK                                 what a pull request hands in
"""
_SITE = """\
  splashbench benchmark site BENCHMARK SITE                             the leaderboard, for any web server
  splashbench benchmark site BENCHMARK SITE --scenes REAL               submissions scored again
"""
EXAMPLES = f"{_INIT}{_CHECK}{_SITE}"
_SITE_FILE = "benchmark_site.json"


def register(actions: argparse._SubParsersAction) -> None:
    """Add the actions to those of `splashbench benchmark`."""
    init_parser = add_command(
        actions,
        "init",
        init,
        summary="a new public benchmark, with its workflow",
        description="Write a new benchmark: its scenes, how to hand in a method, a workflow that publishes the page.",
        epilog=f"examples:\n{_INIT}\nFOLDER may be an empty git repository. See docs/benchmark.md.\n",
    )
    init_parser.add_argument("folder", type=Path, metavar="FOLDER", help="folder of the benchmark")
    init_parser.add_argument("--title", default="Splashing liquids", help="what the benchmark is called")
    init_parser.add_argument(
        "--scenes",
        nargs="+",
        action="extend",
        default=[],
        metavar="DIR",
        help="scenes, or folders of some, whose digests are noted (default: the 20 released ones, by name)",
    )
    init_parser.add_argument(
        "--install",
        metavar="REQUIREMENT",
        help="what the workflow installs: git+https://HOST/PATH@TAG (or @COMMIT), or a wheel's path in the repository "
        "(default: the wheel in wheels/, which you put there)",
    )
    check_parser = add_command(
        actions,
        "check",
        check,
        summary="whether what was handed in can be shown",
        description="Check every entry of a benchmark; a status of 1 says that one has a fault.",
        epilog=f"examples:\n{_CHECK}\nNothing that was handed in is run, and no link is followed.\n",
    )
    check_parser.add_argument("folder", type=Path, metavar="FOLDER", help="folder of the benchmark")
    site_parser = add_command(
        actions,
        "site",
        site,
        summary="a static leaderboard site from a benchmark",
        description="Make a static site of a benchmark: what was handed in, with means, and the whole leaderboard.",
        epilog=f"""\
examples:
{_SITE}
SITE gets index.html, leaderboard/ and {_SITE_FILE}; its pages need nothing but themselves. Entries with
faults are named on the page and left out. Without --scenes figures are as they were handed in. With it every submission
that is at hand is scored again: that finds edited results, not forged renders.
""",
    )
    site_parser.add_argument("folder", type=Path, metavar="FOLDER", help="folder of the benchmark")
    site_parser.add_argument("out", type=Path, metavar="SITE", help="folder of the site; an earlier one is replaced")
    site_parser.add_argument(
        "--scenes", type=Path, nargs="+", default=[], metavar="DIR", help="the scenes, to score submissions again"
    )
    add_lpips_weights(site_parser)


def init(arguments: argparse.Namespace) -> int:
    """Handle `splashbench benchmark init`."""
    from splashbench.benchmark.repository import MAKE_WHEEL, WHEELS, init_benchmark, install_words
    from splashbench.benchmark.scenes import find_scenes
    from splashbench.scene import Scene

    install_words(arguments.install)  # before scenes are read
    scenes = [Scene.open(path) for path in find_scenes(arguments.scenes)]
    files = init_benchmark(arguments.folder, arguments.title, scenes, arguments.install)
    for file in files:
        say(f"wrote {file}")
    if arguments.install is None:
        say(f"next: `{MAKE_WHEEL.format(arguments.folder / WHEELS)}` of a clone of splashbench, for the workflow")
    say(f"next: `git init`, commit, push; others hand in as {arguments.folder / 'README.md'} says")
    if arguments.json:
        emit({"folder": str(arguments.folder), "files": [str(file) for file in files]})
    return 0


def check(arguments: argparse.Namespace) -> int:
    """Handle `splashbench benchmark check`."""
    from splashbench.benchmark.repository import read_benchmark, read_entries, workflow_fault
    from splashbench.errors import one_line

    entries = read_entries(arguments.folder, read_benchmark(arguments.folder), with_scenes=False)
    faulty = _tell_faults(entries, "error")
    unfit = one_line(workflow_fault(arguments.folder))
    if unfit:  # no fault of who hands in
        say(f"warning: {unfit}")
    results = sum(len(entry.results) for entry in entries)
    say(f"{len(entries)} entries, {results} results, {len(faulty)} entries with faults")
    if arguments.json:
        emit(
            {
                "entries": len(entries),
                "results": results,
                "faults": {e.name: e.faults for e in faulty},
                "workflow": unfit,
            }
        )
    return 1 if faulty else 0


def _tell_faults(entries: list[Entry], word: str) -> list[Entry]:
    from splashbench.errors import one_line

    faulty = [entry for entry in entries if entry.faults]
    for entry in faulty:
        for fault in entry.faults:
            say(f"{word}: {one_line(fault)}")
    return faulty


def site(arguments: argparse.Namespace) -> int:
    """Handle `splashbench benchmark site`."""
    from splashbench.benchmark.repository import find_repeats, read_benchmark, read_entries
    from splashbench.benchmark.site import entry_lines, front_page, site_facts
    from splashbench.errors import SplashbenchError
    from splashbench.files import files_together, require_folder_place, require_unsealed_place, write_json, write_text

    if arguments.lpips_weights and not arguments.scenes:
        arguments.usage_error("--lpips-weights is for --scenes; add it")
    out: Path = arguments.out
    benchmark = read_benchmark(arguments.folder)
    require_folder_place(out)
    require_unsealed_place(out)
    if out.is_dir() and any(out.iterdir()) and not (out / _SITE_FILE).is_file():
        raise SplashbenchError(f"{out} holds files that are no site's; give a new or an empty folder")
    entries = read_entries(arguments.folder, benchmark, with_scenes=bool(arguments.scenes))
    with tempfile.TemporaryDirectory(prefix="splashbench-site-") as scratch:
        good = [entry for entry in entries if not entry.faults]
        _score_the_rest(good, benchmark, Path(scratch, "scored"), arguments)
        find_repeats(good)
        good = [entry for entry in good if not entry.faults]
        faulty = _tell_faults(entries, "warning: left out")
        text = _leaderboard(good, benchmark, Path(scratch, "results"), arguments)
    lines = entry_lines(benchmark, good, text)
    with files_together(out) as staging:
        write_json(staging / _SITE_FILE, site_facts(benchmark, lines, faulty))
        write_text(staging / "index.html", front_page(benchmark, lines, faulty, readable=bool(text)))
    say(f"{len(good)} entries, {len(lines)} methods, {len(faulty)} entries left out")
    say(f"wrote {out / 'index.html'}")
    if arguments.json:
        emit({"out": str(out), **site_facts(benchmark, lines, faulty)})
    return 0


def _score_the_rest(entries: list[Entry], benchmark: Benchmark, place: Path, arguments: argparse.Namespace) -> None:
    """Score the submissions of entries that came without results."""
    from splashbench.benchmark.repository import result_fault
    from splashbench.benchmark.scenes import find_scenes
    from splashbench.errors import SplashbenchError
    from splashbench.scene import Scene
    from splashbench.score import score_submission
    from splashbench.submission import Submission
    from splashbench.submission.submission import check_submission

    bare = [entry for entry in entries if not entry.results]
    if not bare:
        return
    scenes = {scene.name: scene for scene in map(Scene.open, find_scenes([str(path) for path in arguments.scenes]))}
    for entry in bare:
        for name in entry.submissions:
            say(f"scoring {entry.name}/{name}")
            try:
                submission = Submission.open(entry.folder / name)
                scene = scenes.get(submission.identity.scene)
                if scene is None:
                    raise SplashbenchError(f"it is of {submission.identity.scene!r}, which is none of --scenes")
                unfit = check_submission(entry.folder / name, scene)
                if unfit:
                    raise SplashbenchError(unfit[0])
                result = score_submission(scene, submission, None, arguments.lpips_weights)
                fault = result_fault(result, benchmark)
                if fault:
                    raise SplashbenchError(f"its result {fault}")
            except SplashbenchError as error:
                entry.faults.append(f"{entry.folder / name} cannot be scored: {error}")
                continue
            entry.results[result.save(place / entry.name).name] = result


def _leaderboard(entries: list[Entry], benchmark: Benchmark, place: Path, arguments: argparse.Namespace) -> str:
    """Make SITE/leaderboard of the entries' results; returns its CSV, "" where there is no result."""
    from splashbench.benchmark.scenes import find_scenes
    from splashbench.cli.main import run_within
    from splashbench.errors import SplashbenchError

    board = arguments.out / "leaderboard"
    for entry in entries:
        for result in entry.results.values():
            result.save(place / entry.name)
    if not place.is_dir():
        if board.is_dir():
            shutil.rmtree(board)
        return ""
    words = ["leaderboard", str(place), str(board), *(["--with-paper"] if benchmark.paper else [])]
    if arguments.scenes:
        folders = [str(entry.folder) for entry in entries if entry.submissions]
        words += ["--verify", "--scenes", *map(str, find_scenes([str(path) for path in arguments.scenes]))]
        words += ["--submissions", *folders] if folders else []
        words += ["--lpips-weights", str(arguments.lpips_weights)] if arguments.lpips_weights else []
    if run_within(words):
        raise SplashbenchError(f"the leaderboard of {arguments.folder} was not made; see the lines above")
    return (board / "leaderboard.csv").read_text(encoding="utf-8")
