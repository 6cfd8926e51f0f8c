"""A public benchmark as a folder under git: what it asks for, and what others handed in, checked.

`benchmark.toml` names the scenes. `entries/NAME/` is one method's: `entry.toml` says whose it is, and results (*.json,
from `splashbench score`) or whole submissions lie beside it. All of it may be a stranger's: nothing in it is run, links
are not followed, and every file is read within limits.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from importlib.resources import files
from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field, field_validator

from splashbench import toml
from splashbench.errors import SplashbenchError, one_line
from splashbench.files import atomic_directory, list_files, read_plain, validate_model, write_text
from splashbench.manifest import load_scenes
from splashbench.scene import Scene
from splashbench.score import PROTOCOL_V1, Result

BENCHMARK_FILE, ENTRY_FILE, ENTRIES = "benchmark.toml", "entry.toml", "entries"
WORKFLOW = ".github/workflows/benchmark.yml"
#: Where the workflow finds splashbench, and how to put it there. No package index has splashbench: whoever took its
#: name there would run code in the workflow.
WHEELS, WHEEL = "wheels", "./wheels/splashbench-*.whl"
MAKE_WHEEL = "python -m pip wheel --no-deps -w {} SPLASHBENCH"
#: Of a benchmark: entries, and of an entry: files and bytes, submissions included.
MAX_ENTRIES, MAX_FILES, MAX_BYTES = 2000, 20_000, 4 << 30
_NAME = re.compile(r"[a-z0-9][a-z0-9_-]{0,59}")
_WEB = re.compile(r"https?://[^\s<>\"']{3,300}")
_MAX_TEXT = 500
# They stand in a shell script, in YAML and in Markdown, unquoted: letters that mean nothing in any of them, no more.
_GIT = re.compile(r"git\+https://[A-Za-z0-9][A-Za-z0-9.-]*(:[0-9]+)?(/[A-Za-z0-9._~-]+)+@[A-Za-z0-9][A-Za-z0-9._/-]*")
_WHEEL_FILE = re.compile(r"(\./)?(([A-Za-z0-9_][A-Za-z0-9._+-]*/)*[A-Za-z0-9_][A-Za-z0-9._+-]*\.whl)")
_MAX_INSTALL, _MAX_WORKFLOW_BYTES = 300, 1 << 20
# What workflows had that splashbench wrote before.
_FROM_INDEX = re.compile(r"pip install [\"']?splashbench(?![\w/.-])")
# The wheel that a workflow installs; its name may be a pattern.
_INSTALLED = re.compile(r"pip install (?P<path>\./(?P<folder>(?:[\w+-][\w.+-]*/)*)(?P<name>[\w.+*-]+\.whl))\s")


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class BenchmarkScene(_Strict):
    """A scene that counts. digest: of its very bytes (`splashbench scene info`), or None for any scene of that name."""

    name: str = Field(pattern=r"^[A-Za-z0-9_][A-Za-z0-9_.-]{0,99}$")
    digest: str | None = Field(default=None, pattern=r"^[0-9a-f]{64}$")


class Benchmark(_Strict):
    """benchmark.toml. paper: a scene_set of the paper's tables that stands beside, "" for none."""

    schema_version: Literal[1] = 1
    title: str = Field(min_length=1, max_length=100)
    about: str = Field(default="", max_length=2000)
    paper: str = "real_20"
    scenes: tuple[BenchmarkScene, ...] = Field(min_length=1, max_length=1000)


class EntryFacts(_Strict):
    """entry.toml: whose the entry is."""

    title: str = Field(min_length=1, max_length=100)
    authors: str = Field(min_length=1, max_length=_MAX_TEXT)
    code: str = ""
    paper: str = ""
    note: str = Field(default="", max_length=_MAX_TEXT)

    @field_validator("code", "paper")
    @classmethod
    def _web(cls, value: str) -> str:
        if value and not _WEB.fullmatch(value):
            raise ValueError("must be an address that begins with https:// or http://")
        return value


@dataclass
class Entry:
    """What somebody handed in.

    Attributes:
        name, folder: of the entry.
        facts: what entry.toml says, None where it cannot be read.
        results: path relative to the folder -> result.
        submissions: folders of submissions, relative to the entry's.
        faults: why it is not shown, a line each; empty where it is.
    """

    name: str
    folder: Path
    facts: EntryFacts | None = None
    results: dict[str, Result] = field(default_factory=dict)
    submissions: list[str] = field(default_factory=list)
    faults: list[str] = field(default_factory=list)


def read_benchmark(folder: Path) -> Benchmark:
    """What the benchmark in `folder` asks for. Raises SplashbenchError where there is none."""
    path = Path(folder, BENCHMARK_FILE)
    if not path.is_file():
        raise SplashbenchError(f"{path} is missing; make a benchmark with `splashbench benchmark init {folder}`")
    return validate_model(path, Benchmark, toml.load(path))


def read_entries(folder: Path, benchmark: Benchmark, with_scenes: bool = False) -> list[Entry]:
    """Every entry of the benchmark in `folder`, in the order of names, with its faults.

    with_scenes: whether submissions can be scored, so that an entry may do without results.
    """
    place = Path(folder, ENTRIES)
    if not place.is_dir():
        raise SplashbenchError(f"{place} is missing; a benchmark keeps there what is handed in, a folder for each")
    if place.is_symlink():
        raise SplashbenchError(f"{place} is a link; make it a folder")
    names = sorted(path.name for path in place.iterdir() if _is_handed_in(path))
    if len(names) > MAX_ENTRIES:
        raise SplashbenchError(f"{place} has {len(names)} entries, more than {MAX_ENTRIES}; split the benchmark")
    entries = [_read_entry(place / name, benchmark, with_scenes) for name in names]
    find_repeats(entries)
    return entries


def _is_handed_in(path: Path) -> bool:
    """Whether `path` is a folder, or a link or file that somebody takes for an entry; notes beside them are neither."""
    if path.name.startswith("."):
        return False
    return path.is_dir() or path.is_symlink() or path.suffix in (".json", ".toml")


def _read_entry(folder: Path, benchmark: Benchmark, with_scenes: bool) -> Entry:
    entry = Entry(folder.name, folder)
    if folder.is_symlink():
        entry.faults.append(f"{folder} is a link; hand in the files themselves")
        return entry
    if not folder.is_dir():
        entry.faults.append(f"{folder} is no folder; make one for the entry, and move the file into it")
        return entry
    if not _NAME.fullmatch(folder.name):
        entry.faults.append(
            f"{folder}: the name may have a-z, 0-9, - and _ alone, 60 letters at most; rename the folder"
        )
    try:
        listing = list_files(folder, MAX_FILES)
        if listing.faults:  # links among them: nothing is read then, as what they lead to would be shown
            entry.faults += listing.faults
            return entry
        entry.facts = _facts(folder)
    except SplashbenchError as error:
        entry.faults.append(str(error))
        return entry
    if listing.bytes > MAX_BYTES:
        entry.faults.append(
            f"{folder} has {listing.bytes >> 20} MiB, more than {MAX_BYTES >> 20}; publish renders elsewhere"
        )
        return entry
    places = (name.rpartition("/") for name in listing.names)
    entry.submissions = sorted(place for place, _, name in places if name == "submission.toml")
    for name in listing.names:
        if name.endswith(".json") and not any(name.startswith(f"{place}/") or not place for place in entry.submissions):
            _take_result(entry, name, benchmark)
    if not entry.results and not entry.faults:
        if not entry.submissions:
            entry.faults.append(f"{folder} holds no result (*.json, from `splashbench score`); add some")
        elif not with_scenes:
            entry.faults.append(f"{folder} holds submissions and no result; add those of `splashbench score`")
    return entry


def _facts(folder: Path) -> EntryFacts:
    path = folder / ENTRY_FILE
    if not path.is_file():
        raise SplashbenchError(f"{path} is missing; it says title and authors")
    return validate_model(path, EntryFacts, toml.load(path))


def _take_result(entry: Entry, name: str, benchmark: Benchmark) -> None:
    path = entry.folder / name
    try:
        result = Result.load(path)
    except SplashbenchError as error:
        entry.faults.append(str(error))
        return
    fault = result_fault(result, benchmark)
    if fault:
        entry.faults.append(f"{path} {fault}")
    else:
        entry.results[name] = result


def result_fault(result: Result, benchmark: Benchmark) -> str:
    """Why a result does not count here; empty where it does."""
    of_name = [scene for scene in benchmark.scenes if scene.name == result.scene]
    if not of_name:
        return f"is of the scene {one_line(result.scene)[:60]!r}, which {BENCHMARK_FILE} does not name; remove it"
    if all(scene.digest not in (None, result.digests.scene) for scene in of_name):
        return f"is of another {result.scene} than the benchmark's (other files); run the method on that"
    if result.protocol != PROTOCOL_V1 or result.digests.protocol != PROTOCOL_V1.digest:
        return f"was scored by another protocol than {PROTOCOL_V1.label}; score the submission again"
    return ""


def find_repeats(entries: Sequence[Entry]) -> None:
    """A run may be handed in once: two entries with one method, settings, scene, seed and hints would push each other
    out."""
    first: dict[tuple[str, ...], str] = {}
    for entry in entries:
        mine: dict[tuple[str, ...], str] = {}
        for name, result in entry.results.items():
            run = (result.method, result.preset, result.settings_digest, str(result.seed))
            key = (*run, result.digests.scene, result.hardware_label, str(result.told))
            other = first.get(key) or mine.get(key)
            if other is not None:
                entry.faults.append(
                    f"{entry.folder / name} and {other} are of one method, settings, scene and seed; keep one of them, "
                    "or give the method another name or version"
                )
            mine[key] = str(entry.folder / name)
        if not entry.faults:
            first |= mine


def install_words(requirement: str | None) -> str:
    """What the workflow gives `pip install`: `requirement`, or the wheel in WHEELS for None.

    Raises SplashbenchError but for a git address with a tag or commit, and the path of a wheel in the repository.
    """
    if requirement is None:
        return WHEEL
    if len(requirement) <= _MAX_INSTALL:
        if _GIT.fullmatch(requirement):
            return requirement
        wheel = _WHEEL_FILE.fullmatch(requirement)
        if wheel:
            return f"./{wheel[2]}"
    raise SplashbenchError(
        f"--install {requirement[:80]!r} cannot stand in a workflow; give git+https://HOST/PATH@TAG (or @COMMIT), or "
        f"the path of a wheel in the repository, such as {WHEELS}/NAME.whl"
    )


def _origin(words: str) -> str:
    """For README.md: where what the workflow installs comes from."""
    if not words.endswith(".whl"):
        return "For another version, change the tag there and in step 1 above."
    place = words.rpartition("/")[0].removeprefix("./") or "."
    return (
        f"`{MAKE_WHEEL.format(place)}` puts that wheel there, where SPLASHBENCH is a clone of splashbench, or\n"
        "`git+https://HOST/PATH@TAG`. A new version replaces the old wheel."
    )


def workflow_fault(folder: Path) -> str:
    """Why the workflow of the benchmark in `folder` cannot install splashbench; empty where no fault is seen."""
    path = Path(folder, WORKFLOW)
    if not path.is_file():
        return ""
    text = read_plain(path, _MAX_WORKFLOW_BYTES).decode("utf-8", "replace")
    if _FROM_INDEX.search(text):
        return (
            f"{path} asks a package index for splashbench, which none has: whoever takes its name runs code here; "
            f"install {WHEEL} instead, made by `{MAKE_WHEEL.format(Path(folder, WHEELS))}` of a clone of splashbench"
        )
    found = _INSTALLED.search(text)
    if found is None:
        return ""
    place = Path(folder, found["folder"])
    count = sum(fnmatchcase(each.name, found["name"]) for each in place.iterdir()) if place.is_dir() else 0
    if count == 1:
        return ""
    return (
        f"{path} installs {found['path']}, of which there {'is none' if not count else f'are {count}'}; keep one wheel "
        f"there, made by `{MAKE_WHEEL.format(place)}` of a clone of splashbench"
    )


def init_benchmark(folder: Path, title: str, scenes: Sequence[Scene] = (), install: str | None = None) -> list[Path]:
    """Write a new benchmark into `folder`, which may be a git repository without files; returns what was written.

    scenes: those that count, with their digests; the 20 released ones, by name, for none.
    install: what its workflow gives `pip install`, see `install_words`.
    """
    folder = Path(folder)
    words = install_words(install)
    if folder.is_dir() and any(path.name != ".git" for path in folder.iterdir()):
        raise SplashbenchError(f"{folder} holds files; give a new folder, or an empty git repository")
    title = one_line(title)
    tables = [{"name": scene.name, "digest": scene.digest} for scene in scenes]
    tables = tables or [{"name": name} for name in load_scenes()]
    values = {"schema_version": 1, "title": title, "about": "", "paper": "" if scenes else "real_20", "scenes": tables}
    validate_model(folder / BENCHMARK_FILE, Benchmark, values)
    text = toml.dumps(values)
    template = files("splashbench.benchmark").joinpath("template")
    readme, workflow = (
        template.joinpath(name).read_text(encoding="utf-8").replace("@INSTALL@", words)
        for name in ("README.md", "workflow.yml")
    )
    contents = {
        BENCHMARK_FILE: text,
        "README.md": readme.replace("@WHEEL@", _origin(words)).replace("@TITLE@", title),
        WORKFLOW: workflow,
        f"{ENTRIES}/.gitkeep": "",
        ".gitignore": "/site/\n",
    }
    if install is None:
        contents[f"{WHEELS}/.gitkeep"] = ""
    if (folder / ".git").exists():
        for name, content in contents.items():
            write_text(folder / name, content)
    else:
        with atomic_directory(folder) as staging:
            for name, content in contents.items():
                write_text(staging / name, content)
    return [folder / name for name in contents]
