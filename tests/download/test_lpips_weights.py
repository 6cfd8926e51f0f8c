"""`splashbench download lpips-weights`: two public files become one .npz, which `score` finds without any option."""

from __future__ import annotations

import json
import os
import shutil
import signal
import socket
import subprocess
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from splashbench.cache import cache_folder
from splashbench.cli.main import main
from splashbench.download import lpips_weights as module
from splashbench.download.fetch import Patience
from splashbench.download.lpips_weights import OFFICIAL, Sources, download_lpips_weights
from splashbench.errors import SplashbenchError
from splashbench.harness.oracle import write_oracle
from splashbench.scene import Scene
from splashbench.score import Result
from splashbench.score.image.lpips import load_lpips
from splashbench.score.image.weights import ALEXNET_FILE, HEADS_FILE, WEIGHTS_SHA256

QUICK = Patience(tries=2, wait_seconds=0.0, timeout_seconds=5.0)
COMMAND = ("download", "lpips-weights")
NAME = "lpips_alex_v0.1.npz"


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The cache folder of this test; no weights come from elsewhere."""
    monkeypatch.delenv("SPLASHBENCH_LPIPS_WEIGHTS", raising=False)
    monkeypatch.delenv("SPLASHBENCH_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "caches"))
    return tmp_path / "caches" / "splashbench"


def write_checkpoints(arrays: dict[str, np.ndarray], folder: Path) -> Path:
    """The two files as their publishers have them, with `arrays` in them; AlexNet's classifier is most of its file."""
    import torch

    tensors = {name: torch.from_numpy(np.asarray(array)) for name, array in arrays.items()}
    alexnet = {
        f"features.{layer}.{part}": tensors[f"conv{i}.{part}"]
        for i, layer in enumerate((0, 3, 6, 8, 10), start=1)
        for part in ("weight", "bias")
    }
    folder.mkdir()
    torch.save(alexnet | {"classifier.1.weight": torch.rand(1024, 2048)}, folder / ALEXNET_FILE)
    heads = {f"lin{i}.model.1.weight": tensors[f"lin{i}"].reshape(1, -1, 1, 1) for i in range(5)}
    torch.save(heads, folder / HEADS_FILE, _use_new_zipfile_serialization=False)  # as its authors saved it
    return folder


@pytest.fixture(scope="module")
def real(test_data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with both checkpoints, of the true weights."""
    path = test_data / "weights" / NAME
    if not path.is_file():
        pytest.skip(f"SPLASHBENCH_TEST_DATA holds no weights/{NAME}")
    with np.load(path) as arrays:
        return write_checkpoints(dict(arrays), tmp_path_factory.mktemp("real") / "checkpoints")


@pytest.fixture(scope="module")
def other(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with both checkpoints, of weights that nobody trained."""
    arrays: dict[str, np.ndarray] = {f"lin{i}": np.ones(4, np.float32) for i in range(5)}
    for i in range(1, 6):
        arrays |= {f"conv{i}.weight": np.ones((4, 3, 3, 3), np.float32), f"conv{i}.bias": np.ones(4, np.float32)}
    return write_checkpoints(arrays, tmp_path_factory.mktemp("other") / "checkpoints")


@pytest.fixture
def serve(server: Any, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Sources]:
    """Have the command fetch the checkpoints of a folder from a server on this machine."""

    def begin(folder: Path, **how: object) -> Sources:
        alexnet, _ = server.add(ALEXNET_FILE, (folder / ALEXNET_FILE).read_bytes(), **how)
        heads, _ = server.add(HEADS_FILE, (folder / HEADS_FILE).read_bytes())
        sources = Sources(alexnet, heads)
        local = partial(download_lpips_weights, sources=sources, patience=QUICK)
        monkeypatch.setattr(module, "download_lpips_weights", local)
        return sources

    return begin


def left(folder: Path) -> list[str]:
    """Names of all files below `folder`, but for the lock."""
    names = (path.name for path in folder.rglob("*") if path.is_file())
    return sorted(name for name in names if not name.endswith(".lock"))


def run(*words: object) -> int:
    return main([str(word) for word in words])


def test_after_one_command_score_has_lpips(
    real: Path, serve: Any, server: Any, cache: Path, balls: Scene, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    serve(real, cuts=[3_000_000])
    loaded, reason = load_lpips()
    assert loaded is None
    assert "run `splashbench download lpips-weights` once" in reason
    assert run(*COMMAND, "--json") == 0
    out, err = capsys.readouterr()
    assert json.loads(out) == {"weights": str(cache / NAME), "sha256": WEIGHTS_SHA256, "made": True}
    assert f"wrote {cache / NAME}, verified" in err
    assert server.files[ALEXNET_FILE].asked == ["", "bytes=3000000-"]
    assert left(tmp_path / "caches") == [NAME]
    assert (cache / NAME).stat().st_size < 10_000_000

    write_oracle(balls, tmp_path / "oracle")
    score = ("score", tmp_path / "oracle", "--scene", balls.directory, "--out", tmp_path / "results")
    assert run(*score) == 0
    assert "null lpips" not in capsys.readouterr().err
    (path,) = (tmp_path / "results").glob("*.json")
    result = Result.load(path)
    assert result.value("lpips") == 0.0
    assert result.digests.lpips_weights == WEIGHTS_SHA256

    server.files.clear()  # from here on any request fails
    assert run(*COMMAND, "--json") == 0
    out, err = capsys.readouterr()
    assert json.loads(out)["made"] is False
    assert err == f"{cache / NAME} is there and verified; nothing to do\n"


def test_what_was_fetched_comes_after_what_is_named(real: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert run(*COMMAND, "--from", real) == 0
    assert load_lpips()[0] is not None
    monkeypatch.setenv("SPLASHBENCH_LPIPS_WEIGHTS", "nowhere.npz")
    with pytest.raises(SplashbenchError, match=r"nowhere.npz does not exist"):
        load_lpips()


def test_files_fetched_by_hand_need_no_network_and_stay(
    real: Path, cache: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = left(real)
    assert run(*COMMAND, "--from", real, "--to", tmp_path / "there") == 0
    assert f"score with --lpips-weights {tmp_path / 'there' / NAME}" in capsys.readouterr().err
    assert left(tmp_path / "there") == [NAME]
    assert left(real) == before
    assert not cache.exists()
    assert load_lpips()[0] is None
    assert load_lpips(tmp_path / "there" / NAME)[0] is not None


def test_a_damaged_file_is_told_and_replaced(
    real: Path, cache: Path, balls: Scene, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(*COMMAND, "--from", real) == 0
    content = bytearray((cache / NAME).read_bytes())
    content[5_000_000] ^= 1
    (cache / NAME).write_bytes(content)
    write_oracle(balls, tmp_path / "oracle")
    capsys.readouterr()
    assert run("score", tmp_path / "oracle", "--scene", balls.directory, "--out", tmp_path / "results") == 1
    line = capsys.readouterr().err.splitlines()[-1]
    assert line == (
        f"error: {cache / NAME} is damaged or no file of LPIPS weights; "
        "`splashbench download lpips-weights` replaces it"
    )
    assert run(*COMMAND, "--from", real) == 0
    assert "is made anew" in capsys.readouterr().err
    assert load_lpips()[0] is not None


def refused(capsys: pytest.CaptureFixture[str], *words: object) -> str:
    """The one error line of a command that must fail."""
    capsys.readouterr()
    assert run(*words) == 1
    captured = capsys.readouterr()
    assert captured.out == ""
    lines = captured.err.splitlines()
    assert [line for line in lines if line.startswith("error: ")] == lines[-1:]
    return lines[-1]


def test_other_weights_keep_nothing(
    other: Path, serve: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    serve(other)
    assert "hold other weights than those of LPIPS v0.1 with AlexNet" in refused(capsys, *COMMAND)
    assert left(tmp_path / "caches") == []
    assert "hold other weights" in refused(capsys, *COMMAND, "--from", other)
    assert left(tmp_path / "caches") == []


def test_a_wrong_checksum_keeps_nothing(
    other: Path, serve: Any, server: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    sources = serve(other)
    content = server.files[ALEXNET_FILE].content
    server.files[ALEXNET_FILE].content = b"?" + content[1:]
    line = refused(capsys, *COMMAND)
    assert f"{sources.alexnet.url} has not the SHA-256 {sources.alexnet.sha256}, nothing was kept" in line
    assert [name for name in left(tmp_path / "caches") if name != HEADS_FILE] == []


def test_without_a_network_one_line_says_what_to_do(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    for name in ("https_proxy", "HTTPS_PROXY"):
        monkeypatch.setenv(name, f"http://127.0.0.1:{port}")
    for name in ("no_proxy", "NO_PROXY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr("splashbench.download.fetch.time", SimpleNamespace(sleep=lambda seconds: None, monotonic=int))
    line = refused(capsys, *COMMAND)
    assert line == (
        f"error: {OFFICIAL.heads.url} could not be fetched: Connection refused; check the network, or fetch "
        f"{OFFICIAL.alexnet.url} and {OFFICIAL.heads.url} by other means into one folder, and give it by --from FOLDER"
    )
    assert left(tmp_path / "caches") == []


def test_files_by_hand_that_are_missing_or_no_weights_are_one_line(
    other: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    given = tmp_path / "given"
    assert f"{given / ALEXNET_FILE} does not exist; fetch it from {OFFICIAL.alexnet.url}" in refused(
        capsys, *COMMAND, "--from", given
    )
    shutil.copytree(other, given)
    (given / HEADS_FILE).unlink()
    assert f"{given / HEADS_FILE} does not exist; fetch it from {OFFICIAL.heads.url}" in refused(
        capsys, *COMMAND, "--from", given
    )
    for content in (b"", b"<html>log in</html>", (other / ALEXNET_FILE).read_bytes()[:10_000]):
        (given / HEADS_FILE).write_bytes(content)
        line = refused(capsys, *COMMAND, "--from", given)
        assert f"{given / HEADS_FILE} " in line
        assert "--lpips-weights" not in line  # an option of other commands
    (given / HEADS_FILE).write_bytes((other / ALEXNET_FILE).read_bytes())
    assert "lacks the weights lin0.model.1.weight" in refused(capsys, *COMMAND, "--from", given)
    assert left(tmp_path / "caches") == []


class Harmful:
    """A pickle of this writes a file."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, (str(self.path),)


def test_what_is_in_the_files_is_never_run(other: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    import torch

    given = Path(shutil.copytree(other, tmp_path / "given"))
    torch.save({"lin0.model.1.weight": Harmful(tmp_path / "ran")}, given / HEADS_FILE)
    line = refused(capsys, *COMMAND, "--from", given)
    assert f"{given / HEADS_FILE} holds no plain weights" in line
    assert "weights_only" not in line
    assert not (tmp_path / "ran").exists()


def test_a_place_that_cannot_be_is_told_before_the_work(
    tmp_path: Path, serve: Any, other: Path, server: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    serve(other)
    (tmp_path / "file").write_text("mine")
    assert f"{tmp_path / 'file'} is a file" in refused(capsys, *COMMAND, "--to", tmp_path / "file")
    (tmp_path / "folder" / NAME).mkdir(parents=True)
    assert f"{NAME} is a folder" in refused(capsys, *COMMAND, "--to", tmp_path / "folder")
    assert server.files[HEADS_FILE].asked == []


def start(sources: Sources) -> subprocess.Popen[str]:
    """The command in a process of its own."""
    code = (
        "import sys\nfrom functools import partial\nfrom splashbench.cli.main import main\n"
        "from splashbench.download import lpips_weights as module\nfrom splashbench.download.fetch import RemoteFile\n"
        f"sources = module.Sources({sources.alexnet!r}, {sources.heads!r})\n"
        "module.download_lpips_weights = partial(module.download_lpips_weights, sources=sources)\n"
        "sys.exit(main(['download', 'lpips-weights']))\n"
    )
    return subprocess.Popen([sys.executable, "-c", code], stderr=subprocess.PIPE, text=True)


def test_of_two_commands_one_fetches(real: Path, serve: Any, server: Any, cache: Path) -> None:
    sources = serve(real, pause=0.001)
    processes = [start(sources) for _ in range(2)]
    told = sorted(process.communicate(timeout=100)[1] for process in processes)
    assert [process.returncode for process in processes] == [0, 0]
    assert [("wrote " in text, "nothing to do" in text) for text in told].count((True, False)) == 1
    assert [len(server.files[name].asked) for name in (ALEXNET_FILE, HEADS_FILE)] == [1, 1]
    assert left(cache) == [NAME]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_an_interrupted_command_goes_on_where_it_stopped(
    number: signal.Signals,
    real: Path,
    serve: Any,
    server: Any,
    cache: Path,
    wait_for: Callable[[Callable[[], bool]], None],
    capsys: pytest.CaptureFixture[str],
) -> None:
    process = start(serve(real, pause=0.02))
    part = cache / ".lpips-weights" / f"{ALEXNET_FILE}.part"
    wait_for(lambda: part.is_file() and part.stat().st_size > 100_000)
    process.send_signal(number)
    err = process.communicate(timeout=60)[1]
    assert process.returncode == (-number if number == signal.SIGKILL else 128 + number)
    if number != signal.SIGKILL:
        assert err.splitlines()[-1] == "interrupted; the same command goes on where it stopped"
    have = part.stat().st_size
    assert left(cache) == sorted([HEADS_FILE, part.name])
    server.files[ALEXNET_FILE].pause = 0.0
    assert run(*COMMAND) == 0
    assert server.files[ALEXNET_FILE].asked == ["", f"bytes={have}-"]
    assert server.files[HEADS_FILE].asked == [""]
    assert left(cache) == [NAME]


@pytest.mark.parametrize(
    ("variables", "folder"),
    [
        ({"SPLASHBENCH_CACHE": "/a/b", "XDG_CACHE_HOME": "/c"}, "/a/b"),
        ({"XDG_CACHE_HOME": "/c"}, "/c/splashbench"),
        ({"XDG_CACHE_HOME": "relative", "HOME": "/h"}, "/h/.cache/splashbench"),
        ({"XDG_CACHE_HOME": "", "HOME": "/h"}, "/h/.cache/splashbench"),
    ],
)
def test_where_the_cache_is(variables: dict[str, str], folder: str, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    assert cache_folder() == Path(folder)


def test_without_a_home_there_are_no_weights_and_no_crash(monkeypatch: pytest.MonkeyPatch) -> None:
    def no_home() -> Path:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.setenv("XDG_CACHE_HOME", "")
    monkeypatch.setattr(Path, "home", no_home)
    assert load_lpips()[0] is None
    with pytest.raises(SplashbenchError, match="SPLASHBENCH_CACHE"):
        cache_folder()
