"""Results of stages on disk: they come back as they were, and are made anew when something changed or was killed."""

from __future__ import annotations

import json
import os
import random
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import TypeAdapter

from splashbench.alignment import Similarity
from splashbench.cli import prepare as cli_prepare
from splashbench.errors import SplashbenchError
from splashbench.prepare import stage_cache
from splashbench.prepare.audio.clocks import SyncResult
from splashbench.prepare.audio.sync import ClockFit, SequenceSync
from splashbench.prepare.calibration.board import BoardView
from splashbench.prepare.calibration.intrinsics import Calibration
from splashbench.prepare.calibration.lens import Lens
from splashbench.prepare.container import PlacedContainer
from splashbench.prepare.masks.session_masks import CameraMasks
from splashbench.prepare.poses.metric import MetricFrame, Sighting
from splashbench.prepare.poses.rig import PosedRig
from splashbench.prepare.poses.scale import SceneFrame
from splashbench.prepare.stage_cache import STAGES, StageStore, facts_of, open_stages
from splashbench.prepare.video.motion import MotionInterval
from splashbench.prepare.video.sampling import Sampling


@pytest.fixture
def store(tmp_path: Path) -> Iterator[StageStore]:
    with open_stages(tmp_path / "work") as opened:
        yield opened


def same(a: Any, b: Any) -> bool:
    """Whether two results are equal bit for bit, arrays, NaN and types included."""
    if type(a) is not type(b):
        return False
    if isinstance(a, np.ndarray):
        return a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()
    if is_dataclass(a):
        return all(same(getattr(a, entry.name), getattr(b, entry.name)) for entry in fields(a))
    if isinstance(a, dict):
        return list(a) == list(b) and all(same(a[key], b[key]) for key in a)
    if isinstance(a, list | tuple):
        return len(a) == len(b) and all(same(x, y) for x, y in zip(a, b))
    return bool(a == b) or (a != a and b != b)


RNG = np.random.default_rng(3)
LENS = Lens(640, 360, RNG.random((3, 3)), RNG.random(5))
CLOCK = ClockFit(1 / 3, 1 - 49e-6, float("inf"), 1e-5, 2, "ok", ((0.1, -1e-5), (7.3, 2e-5)))
FLAGGED = ClockFit(float("nan"), float("nan"), 1.2, float("nan"), 0, "unrelated")
RESULTS = [
    (dict[str, ClockFit], {"1": CLOCK, "2": FLAGGED}),
    (SyncResult, SyncResult({"1": CLOCK}, {"1": ()}, {})),
    (SequenceSync, SequenceSync(None, {}, ("2", "3"))),
    (SequenceSync, SequenceSync(0.001, {"1": 0.0, "2": 0.0}, (), 0.005)),
    (MotionInterval, MotionInterval(0.1, 2.7, ("given",), {"1": (0.1, 2.7)})),
    (
        Sampling,
        Sampling(
            np.linspace(0, 1, 7) / 3,
            RNG.random(7),
            {"1": np.arange(7)},
            {"1": RNG.random(7)},
            {"1": RNG.random(7) > 0.5},
        ),
    ),
    (Calibration, Calibration(LENS, 0.1, 0.2, 0.3, 0.9, 150, 140, 1, 2, 50, RNG.random((9, 2)))),
    (
        MetricFrame,
        MetricFrame(Similarity(0.3, np.eye(3), np.zeros(3)), 1e-4, 28, 9, 0.28, np.zeros((0, 3))),
    ),
    (
        tuple[Sighting, ...],
        (Sighting(BoardView(np.arange(6), RNG.random((6, 2)), RNG.random((6, 2))), LENS, np.eye(4)),),
    ),
]


@pytest.mark.parametrize(
    "kind",
    [
        SyncResult,
        MotionInterval,
        SequenceSync,
        Sampling,
        Calibration,
        PosedRig,
        SceneFrame,
        PlacedContainer,
        CameraMasks,
    ],
)
def test_every_stage_s_result_can_be_read_back(kind: type) -> None:
    """Annotations that cannot be stored would show only after minutes of work."""
    TypeAdapter(kind)


@pytest.mark.parametrize(("kind", "made"), RESULTS, ids=[str(kind) for kind, _ in RESULTS])
def test_a_result_comes_back_bit_for_bit(store: StageStore, kind: Any, made: Any) -> None:
    store.result("poses", kind, {}, lambda: made)
    again = store.result("poses", kind, {}, lambda: pytest.fail("made twice"))
    assert same(again, made)


def test_only_what_changed_is_made_anew(store: StageStore) -> None:
    made: list[int] = []

    def make() -> int:
        made.append(len(made))
        return made[-1]

    def ask(**inputs: Any) -> int:
        return store.result("sync", int, inputs, make)

    assert [ask(a=1, b=[2.0]), ask(a=1, b=[2.0]), ask(b=[2.0], a=1)] == [0, 0, 0]
    assert ask(a=1, b=[np.nextafter(2.0, 3.0)]) == 1
    assert ask(a=np.zeros(3)) == 2
    assert ask(a=np.zeros((3, 1))) == 3
    assert ask(a=LENS) == 4
    assert ask(a=Lens(641, LENS.height, LENS.K, LENS.distortion)) == 5
    assert store.result("sync", int, {"a": 1}, make, part="1") == 6
    assert store.result("motion", int, {"a": 1}, make) == 7


def test_a_file_counts_by_name_size_and_time(tmp_path: Path) -> None:
    path = tmp_path / "GX010001.MP4"
    path.write_bytes(b"abc")
    first = facts_of([path])
    assert facts_of([path]) == first
    os.utime(path, ns=(0, 12345))
    assert facts_of([path]) != first
    folder = tmp_path / "photographs"
    folder.mkdir()
    (folder / "1.jpg").write_bytes(b"abc")
    before = facts_of([folder])
    (folder / "2.jpg").write_bytes(b"abc")
    assert len(facts_of([folder])) == len(before) + 1


def test_again_from_a_stage_forgets_it_and_what_follows(tmp_path: Path) -> None:
    with open_stages(tmp_path) as store:
        for stage in STAGES:
            store.result(stage, str, {}, lambda: "first")
            store.files(stage, str, {}, lambda folder: (folder / "x").write_text("first") and "first", part="1")
    with open_stages(tmp_path, again_from="poses") as store:
        seen = [store.result(stage, str, {}, lambda: "second") for stage in STAGES]
        parts = [store.files(stage, str, {}, lambda _: "second", part="1")[1] for stage in STAGES]
    kept = STAGES.index("poses")
    assert seen == parts == ["first"] * kept + ["second"] * (len(STAGES) - kept)


def test_a_result_that_cannot_be_read_is_made_anew(store: StageStore) -> None:
    store.result("sync", SequenceSync, {}, lambda: SequenceSync(0.1, {"1": 0.1}, ()))
    path = store.folder / "sync.json"
    whole = json.loads(path.read_text())
    others = [json.dumps({**whole, **change}) for change in ({"result": {"rms_s": "x"}}, {"key": "0"})]
    for text in ("", "{", "[]", "[" * 100_000, *others):
        path.write_text(text)
        assert store.result("sync", SequenceSync, {}, lambda: SequenceSync(0.2, {}, ())).clock_rms_s == 0.2


def test_files_without_their_result_are_rubbish(store: StageStore) -> None:
    def killed(folder: Path) -> int:
        (folder / "half.png").write_text("half")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        store.files("masks", int, {}, killed, part="1")
    folder, value = store.files("masks", int, {}, lambda empty: len(list(empty.iterdir())), part="1")
    assert value == 0
    assert not list(folder.iterdir())


def test_what_cannot_be_stored_is_a_programming_error(store: StageStore) -> None:
    with pytest.raises(TypeError, match="set cannot be stored"):
        store.result("sync", set, {}, lambda: {1})


def test_the_folder_is_one_process_own_and_nobody_elses(tmp_path: Path) -> None:
    def refused(folder: Path, pattern: str) -> None:
        with pytest.raises(SplashbenchError, match=pattern), open_stages(folder):
            pass

    with open_stages(tmp_path / "work"):
        refused(tmp_path / "work", "in use by another")
    with open_stages(tmp_path / "work"):  # given back
        pass
    (tmp_path / "photographs").mkdir()
    (tmp_path / "photographs/holiday.jpg").touch()
    refused(tmp_path / "photographs", "photographs holds something else; name another folder with --work")
    (tmp_path / "file").touch()
    refused(tmp_path / "file", "is a link or a file, not a folder")
    (tmp_path / "link").symlink_to(tmp_path / "work")
    refused(tmp_path / "link", "is a link or a file, not a folder")


def test_a_folder_with_a_readme_of_its_own_is_not_ours(tmp_path: Path) -> None:
    """Results are deleted without asking, so nothing else may be taken for them."""
    (tmp_path / "README.txt").write_text("my notes")
    (tmp_path / "masks").mkdir()
    (tmp_path / "masks/1.png").write_text("mine")
    with (
        pytest.raises(SplashbenchError, match="holds something else"),
        open_stages(tmp_path, again_from="sync") as store,
    ):
        store.forget("sync")
    assert (tmp_path / "README.txt").read_text() == "my notes"
    assert (tmp_path / "masks/1.png").read_text() == "mine"


def test_a_file_that_went_missing_or_changed_is_made_anew(store: StageStore) -> None:
    def make(folder: Path) -> int:
        for name in "ab":
            (folder / name).write_text(name)
        return len(list(folder.iterdir()))

    folder, _ = store.files("masks", int, {}, make, part="1")
    for spoil in (lambda: (folder / "a").unlink(), lambda: (folder / "b").write_text("longer")):
        spoil()
        store.files("masks", int, {}, make, part="1")
        assert [(folder / name).read_text() for name in "ab"] == ["a", "b"]
    store.files("masks", int, {}, lambda _: pytest.fail("nothing was spoilt"), part="1")


def test_the_command_line_names_the_same_stages() -> None:
    """It repeats them, so that its --help need not import this."""
    assert cli_prepare._STAGES == STAGES


def test_time_is_counted_for_what_was_done(tmp_path: Path) -> None:
    with open_stages(tmp_path) as store:
        store.result("masks", int, {}, lambda: time.sleep(0.02) or 1, part="1")
        first = store.records["masks"]
        assert first.spent == first.seconds >= 0.02
    with open_stages(tmp_path) as store:
        store.result("masks", int, {}, lambda: 1, part="1")
        store.result("masks", int, {}, lambda: 2, part="2")
        again = store.records["masks"]
        assert not again.reused
        assert again.spent < again.seconds


CHAIN = """
import sys, time
from pathlib import Path
import numpy as np
from splashbench.prepare.stage_cache import STAGES, open_stages

with open_stages(Path(sys.argv[1])) as store:
    print("begun", flush=True)
    before = 1.0
    for number, stage in enumerate(STAGES):
        def make(folder):
            value = before
            for k in range(20):
                value = float(np.sin(value + k + number) + 2)
                (folder / f"{k}.txt").write_text(f"{value!r}\\n" * 500)
                time.sleep(0.001)
            return value
        folder, before = store.files(stage, float, {"before": before}, make)
        assert len(list(folder.iterdir())) == 20
    print(repr(before), *(len(path.read_text()) for path in sorted(store.folder.rglob("*.txt"))))
"""


def test_killed_at_any_moment_the_outcome_is_the_same(tmp_path: Path) -> None:
    def start(folder: Path) -> subprocess.Popen[str]:
        process = subprocess.Popen(
            [sys.executable, "-c", CHAIN, str(folder)], stdout=subprocess.PIPE, text=True, env=dict(os.environ)
        )
        assert process.stdout is not None
        assert process.stdout.readline() == "begun\n"
        return process

    began = time.perf_counter()
    undisturbed = start(tmp_path / "undisturbed").communicate()[0]
    seconds = time.perf_counter() - began
    assert undisturbed
    moments = random.Random(7)
    for number in range(4):
        process = start(tmp_path / f"killed{number}")
        time.sleep(moments.random() * 0.3 * seconds)
        process.send_signal(signal.SIGKILL)
        process.communicate()
        assert start(tmp_path / f"killed{number}").communicate()[0] == undisturbed


def test_results_depend_on_the_code_of_every_room_that_makes_them() -> None:
    """`prepare`, the rooms that it imports, and those that these import."""
    package = Path(stage_cache.__file__).parents[1]
    found, waiting = set[str](), ["prepare"]
    while waiting:
        room = waiting.pop()
        found.add(room)
        text = "\n".join(path.read_text(encoding="utf-8") for path in (package / room).rglob("*.py"))
        named = set(re.findall(r"from splashbench\.(\w+)", text))
        waiting += [name for name in named - found if (package / name).is_dir()]
    assert set(stage_cache._ROOMS) == found
