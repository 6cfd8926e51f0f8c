"""Parts of the conformance test: pickles and arrays, openings, and what a stopped run must not leave."""

import pickle
import re
import signal
import subprocess
import sys
import zipfile
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from splashbench.harness.conformance import model, stopping
from splashbench.harness.conformance.recording import OpeningWatch
from splashbench.harness.conformance.report import Verdict, judge
from splashbench.harness.conformance.scene_copies import empty_masks, hidden, keep_first_frame
from splashbench.harness.conformance.stopping import StoppedRun, as_pairs, signal_faults
from splashbench.harness.conformance.storage import storage_faults
from splashbench.harness.conformance.subject import Answer
from splashbench.harness.conformance.views import RenderedView, digest
from splashbench.harness.runner import parse_overrides
from splashbench.scene import Scene


def _torch_like(path: Path) -> None:
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("archive/data.pkl", pickle.dumps([1]))


@pytest.mark.parametrize(
    ("name", "write"),
    [
        ("model.pkl", lambda path: path.write_bytes(b"anything")),
        ("model.pt", _torch_like),
        ("model.bin", _torch_like),
        ("model.dat", lambda path: path.write_bytes(pickle.dumps({"a": np.zeros(3)}))),
        ("model.old", lambda path: path.write_bytes(pickle.dumps([1, 2], protocol=2))),
        ("model.npy", lambda path: np.save(path, np.array([{}], dtype=object))),
        ("model.npz", lambda path: np.savez(path, good=np.zeros(3), bad=np.array([None]))),
        ("model.npz", lambda path: np.savez_compressed(path, bad=np.array([None]))),
    ],
)
def test_a_pickle_is_found_under_any_name(tmp_path: Path, name: str, write) -> None:
    (tmp_path / "static").mkdir()
    write(tmp_path / "static" / name)
    (tmp_path / "model.json").write_text("{}")
    assert storage_faults(tmp_path) == [f"static/{name} is or holds a pickle"]


def test_arrays_and_text_are_no_pickles(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", numbers=np.zeros((3, 4)), words=np.array(["a", "b"]), flags=np.ones(2, bool))
    np.savez_compressed(tmp_path / "b.npz", numbers=np.zeros((3, 4), order="F"))
    np.save(tmp_path / "c.npy", np.arange(5))
    (tmp_path / "d.bin").write_bytes(b"\x80\x04" + bytes(50))
    (tmp_path / "e.zip").write_bytes(b"PK\x03\x04 not an archive")
    (tmp_path / "f.txt").write_text("text.")
    (tmp_path / "g.bin").touch()
    assert storage_faults(tmp_path) == []


def test_links_and_nothing_at_all_are_faults(tmp_path: Path) -> None:
    assert storage_faults(tmp_path) == ["save() wrote no file"]
    (tmp_path / "model.npz").symlink_to("/etc/hostname")
    assert storage_faults(tmp_path) == ["model.npz is no plain file"]


def test_openings_are_seen_from_any_process(tmp_path: Path) -> None:
    files = {name: tmp_path / "folder" / name for name in ("read", "native", "unread", "other")}
    (tmp_path / "folder").mkdir()
    for path in files.values():
        path.write_text("text")
    watched = [files[name] for name in ("read", "native", "unread")]
    with OpeningWatch(watched) as openings:
        files["read"].read_text()
        files["other"].read_text()
        files["unread"].stat()
        subprocess.run(["cat", str(files["native"])], stdout=subprocess.DEVNULL, check=True)
    if not openings.complete:
        pytest.skip("this system has no inotify")
    assert openings.opened == [files["native"], files["read"]]
    with OpeningWatch(watched) as openings:
        assert len(list((tmp_path / "folder").iterdir())) == 4
    assert openings.opened == [tmp_path / "folder"]
    files["read"].read_text()
    assert openings.opened == [tmp_path / "folder"]


def test_openings_that_may_have_been_missed_are_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import inotify_simple

    overflow = inotify_simple.Event(-1, inotify_simple.flags.Q_OVERFLOW, 0, "")
    monkeypatch.setattr(inotify_simple.INotify, "read", lambda self, timeout: [overflow])
    with OpeningWatch([tmp_path / "file"]) as openings:
        assert openings.complete
    assert not openings.complete
    with OpeningWatch([tmp_path / "no folder" / "file"]) as openings:
        assert not openings.complete


def test_a_fault_of_the_loaded_model_alone_fails_the_check() -> None:
    good, bad = RenderedView(kind="test", digest="1"), RenderedView(kind="test", fault="camera 6: NaN")
    evidence = SimpleNamespace(fitted=Answer(views={"a": good}), loaded=Answer(views={"a": bad}))
    assert model.views.judgement(evidence) == (Verdict.FAILED, "camera 6: NaN")
    evidence.loaded = Answer(views={"a": good}, window_fault="the part around the middle")
    assert model.views.judgement(evidence) == (Verdict.OK, "1 view")
    assert model.principal_point.judgement(evidence) == (Verdict.FAILED, "the part around the middle")
    evidence.fitted = Answer(ended_in="fit", reason="no memory")
    finding = model.views.finding(evidence)
    assert (finding.verdict, finding.detail) == (Verdict.NOT_TESTED, "the fit ended in fit: no memory")


def test_a_digest_is_of_types_shapes_and_bytes() -> None:
    zeros = np.zeros((2, 3), np.float32)
    others = [zeros.T, zeros.astype(np.int32), zeros + 1, zeros[:1], None]
    assert len({digest(zeros), *(digest(other) for other in others)}) == 6
    assert digest(zeros) == digest(np.asfortranarray(zeros))


def test_a_finding_names_three_faults_and_counts_the_rest() -> None:
    assert judge(list("abc"), "fine") == (Verdict.FAILED, "a; b; c")
    assert judge(list("abcde"), "fine", Verdict.WARNING) == (Verdict.WARNING, "a; b; c (and 2 more)")
    assert judge([], "fine", Verdict.WARNING) == (Verdict.OK, "fine")


def test_hiding_leaves_a_method_what_it_may_see(balls_copy: Path, balls: Scene, tmp_path: Path) -> None:
    copy = hidden(balls_copy, tmp_path / "copy")
    baits = {path.relative_to(balls_copy).as_posix() for path in copy.baits}
    assert "truth/particles.npz" in baits
    assert {f"{kind}/6/000003.png" for kind in ("ims", "seg")} <= baits
    assert not any(name.split("/")[1] in balls.train for name in baits)
    assert all(path.read_bytes().startswith(b"This is a test view") for path in copy.baits)
    training = Scene.open(copy.training).training()
    for name in balls.train:
        assert (training.image(name, 3) == balls.image(name, 3)).all()
        assert (training.mask(name, 3) == balls.mask(name, 3)).all()


def test_scenes_at_the_edge(balls_copy: Path, balls: Scene) -> None:
    empty_masks(balls_copy)
    assert not any(Scene.open(balls_copy).mask(name, t).any() for name in balls.cameras for t in range(balls.n_frames))
    keep_first_frame(balls_copy)
    scene = Scene.open(balls_copy)
    assert scene.n_frames == 1
    assert scene.times.tolist() == balls.times[:1].tolist()
    assert (scene.image("6", 0) == balls.image("6", 0)).all()


def test_what_a_stopped_run_must_not_leave(tmp_path: Path) -> None:
    out = tmp_path / "submission"
    good = StoppedRun(paused=True, exit_code=143, last_line="interrupted")
    assert signal_faults(good, signal.SIGTERM, out) == []
    assert signal_faults(good, signal.SIGINT, out) == ["exit status 143: interrupted"]
    hung = StoppedRun(True, None, "", ["python 7 sleeping"])
    said = ["the run did not end within 20 s (python 7 sleeping): it said nothing"]
    assert signal_faults(hung, signal.SIGINT, out) == said
    early = StoppedRun(paused=False, exit_code=0, last_line="ok")
    assert signal_faults(early, signal.SIGTERM, out) == ["the fit did not get to its middle: ok"]
    (tmp_path / ".tmp-12345678-submission").mkdir()
    assert signal_faults(good, signal.SIGTERM, out) == [".tmp-12345678-submission was left beside the submission"]
    out.mkdir()
    assert "there is a submission" in signal_faults(good, signal.SIGTERM, out)


def test_a_run_that_does_not_end_is_named() -> None:
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as process:
        (line,) = stopping._alive(process.pid)
        assert re.fullmatch(rf"\S+ {process.pid} \w+", line)
        process.communicate(b"\n")
    assert stopping._alive(process.pid) == []


def test_settings_go_through_the_command_line_unchanged() -> None:
    settings = {"a": {"b": 1, "c": {"d": 0.1}}, "text": "5", "none": None, "list": [1, "x"], "yes": True}
    assert parse_overrides(as_pairs(settings)) == settings
