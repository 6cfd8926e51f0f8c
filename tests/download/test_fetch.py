"""One file by HTTP: continued where it stopped, whole and verified or not at all, one line where it fails."""

from __future__ import annotations

import hashlib
import random
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from splashbench.download.connection import may_lead
from splashbench.download.fetch import Patience, RemoteFile, alone, fetch
from splashbench.errors import SplashbenchError

CONTENT = random.Random(0).randbytes(300_000)
QUICK = Patience(tries=3, step_bytes=10_000, wait_seconds=0.0, timeout_seconds=5.0)
REMEDY = "check the network"


def get(file: RemoteFile, target: Path, patience: Patience = QUICK) -> bytes:
    fetch(file, target, remedy=REMEDY, patience=patience)
    assert not target.with_name(f"{target.name}.part").exists()
    return target.read_bytes()


def refusal(file: RemoteFile, target: Path, patience: Patience = QUICK) -> str:
    """The error's text, after checking that it names the address and the remedy, and that nothing took the target."""
    with pytest.raises(SplashbenchError) as caught:
        fetch(file, target, remedy=REMEDY, patience=patience)
    assert file.url in str(caught.value)
    assert str(caught.value).endswith(f"; {REMEDY}")
    assert not target.exists()
    return str(caught.value)


@pytest.mark.parametrize("length", [True, False])
def test_a_file_is_fetched_once(server: Any, tmp_path: Path, length: bool) -> None:
    file, served = server.add("f.bin", CONTENT, length=length)
    assert get(file, tmp_path / "below" / "f.bin") == CONTENT
    assert get(file, tmp_path / "below" / "f.bin") == CONTENT
    assert served.asked == [""]
    assert [path.name for path in (tmp_path / "below").iterdir()] == ["f.bin"]


def test_a_connection_that_breaks_is_continued(server: Any, tmp_path: Path) -> None:
    file, served = server.add("f.bin", CONTENT, cuts=[100_000, 50_000])
    assert get(file, tmp_path / "f.bin") == CONTENT
    assert served.asked == ["", "bytes=100000-", "bytes=150000-"]


def test_a_file_in_many_pieces_arrives_with_few_tries(server: Any, tmp_path: Path) -> None:
    file, served = server.add("f.bin", CONTENT, cuts=[20_000] * 14)
    assert get(file, tmp_path / "f.bin") == CONTENT
    assert len(served.asked) == 15


def test_without_ranges_all_of_it_comes_again(server: Any, tmp_path: Path) -> None:
    file, served = server.add("f.bin", CONTENT, cuts=[100_000, 250_000], ranges=False)
    assert get(file, tmp_path / "f.bin") == CONTENT
    assert served.asked == ["", "bytes=100000-", "bytes=250000-"]


def test_a_connection_that_always_breaks_is_given_up_and_continued_later(server: Any, tmp_path: Path) -> None:
    file, served = server.add("f.bin", CONTENT, cuts=[100_000, 100, 100, 100])
    assert "ended after 100300 of 300000 bytes" in refusal(file, tmp_path / "f.bin")
    assert (tmp_path / "f.bin.part").read_bytes() == CONTENT[:100_300]
    served.cuts = []
    assert get(file, tmp_path / "f.bin") == CONTENT
    assert served.asked[-1] == "bytes=100300-"


def test_what_an_earlier_call_left_is_continued(server: Any, tmp_path: Path) -> None:
    file, served = server.add("f.bin", CONTENT)
    (tmp_path / "f.bin.part").write_bytes(CONTENT[:123_456])
    assert get(file, tmp_path / "f.bin") == CONTENT
    assert served.asked == ["bytes=123456-"]


def test_a_part_that_is_whole_needs_no_request(server: Any, tmp_path: Path) -> None:
    file, served = server.add("f.bin", CONTENT)
    (tmp_path / "f.bin.part").write_bytes(CONTENT)
    assert get(file, tmp_path / "f.bin") == CONTENT
    assert served.asked == []


@pytest.mark.parametrize("left", [b"x" * 100_000, b"x" * 300_000, b"x" * 300_001], ids=["damaged", "whole", "longer"])
def test_a_part_that_is_damaged_is_fetched_anew(server: Any, tmp_path: Path, left: bytes) -> None:
    file, served = server.add("f.bin", CONTENT)
    (tmp_path / "f.bin.part").write_bytes(left)
    assert get(file, tmp_path / "f.bin") == CONTENT
    assert served.asked[-1] == ""


def test_a_file_in_its_place_that_is_damaged_is_fetched_anew(server: Any, tmp_path: Path) -> None:
    file, _ = server.add("f.bin", CONTENT)
    (tmp_path / "f.bin").write_bytes(CONTENT[:-1] + b"?")
    assert get(file, tmp_path / "f.bin") == CONTENT


def test_a_server_that_cannot_continue_is_asked_for_all(server: Any, tmp_path: Path) -> None:
    file, served = server.add("f.bin", CONTENT, statuses=[416])
    (tmp_path / "f.bin.part").write_bytes(CONTENT[:1000])
    assert get(file, tmp_path / "f.bin") == CONTENT
    assert served.asked == ["bytes=1000-", ""]


@pytest.mark.parametrize("shift", [-1000, 1000])
def test_another_part_than_the_one_asked_for_is_never_added(server: Any, tmp_path: Path, shift: int) -> None:
    file, served = server.add("f.bin", CONTENT, shifts=[shift])
    (tmp_path / "f.bin.part").write_bytes(CONTENT[:40_000])
    assert get(file, tmp_path / "f.bin") == CONTENT
    assert served.asked == ["bytes=40000-", ""]


def test_a_wrong_checksum_keeps_nothing(server: Any, tmp_path: Path) -> None:
    file, served = server.add("f.bin", CONTENT)
    assert "has not the SHA-256 " in refusal(replace(file, sha256=hashlib.sha256(b"").hexdigest()), tmp_path / "f.bin")
    assert list(tmp_path.iterdir()) == []
    assert served.asked == [""]


@pytest.mark.parametrize("left", [0, 1000, 299_000])
@pytest.mark.parametrize("length", [True, False])
@pytest.mark.parametrize("change", [-5000, 1])
def test_a_file_of_another_size_is_refused(server: Any, tmp_path: Path, left: int, length: bool, change: int) -> None:
    file, _ = server.add("f.bin", CONTENT, length=length)
    (tmp_path / "f.bin.part").write_bytes(CONTENT[:left])
    server.files["f.bin"].content = CONTENT[:change] if change < 0 else CONTENT + b"x" * change
    text = refusal(file, tmp_path / "f.bin")
    assert "bytes instead of 300000: it was changed, or a login page or proxy answered" in text
    assert list(tmp_path.iterdir()) == []


def test_an_endless_file_is_refused(server: Any, tmp_path: Path) -> None:
    file, _ = server.add("f.bin", CONTENT * 200, length=False)
    assert "it has more than 1000 bytes instead of 1000" in refusal(replace(file, size=1000), tmp_path / "f.bin")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("status", [403, 404, 410])
def test_a_final_answer_is_not_asked_for_again(server: Any, tmp_path: Path, status: int) -> None:
    file, served = server.add("f.bin", CONTENT, statuses=[status] * 3)
    assert f"the server answered {status} " in refusal(file, tmp_path / "f.bin")
    assert len(served.asked) == 1


@pytest.mark.parametrize("status", [408, 429, 500, 503])
def test_a_passing_answer_is_asked_for_again(server: Any, tmp_path: Path, status: int) -> None:
    file, served = server.add("f.bin", CONTENT, statuses=[status] * 2)
    assert get(file, tmp_path / "f.bin") == CONTENT
    served.statuses = [status] * 3
    (tmp_path / "f.bin").unlink()
    assert f"the server answered {status} " in refusal(file, tmp_path / "f.bin")
    assert len(served.asked) == 6


@pytest.mark.parametrize("place", ["file:///etc/hostname", "ftp://127.0.0.1/f.bin", "data:,x", "f.bin"])
def test_a_redirect_out_of_http_or_in_a_circle_is_refused(server: Any, tmp_path: Path, place: str) -> None:
    file, _ = server.add("f.bin", CONTENT, location=place)
    assert f"it leads to {place}, which may not be followed" in refusal(file, tmp_path / "f.bin")
    assert list(tmp_path.iterdir()) == []


def test_a_redirect_within_http_is_followed(server: Any, tmp_path: Path) -> None:
    _, served = server.add("there.bin", CONTENT)
    file, _ = server.add("f.bin", CONTENT, location="/there.bin")
    (tmp_path / "f.bin.part").write_bytes(CONTENT[:1000])
    assert get(file, tmp_path / "f.bin") == CONTENT
    assert served.asked == ["bytes=1000-"]


@pytest.mark.parametrize(
    ("start", "target", "followed"),
    [
        ("https://a.org/x", "https://b.org/y", True),
        ("https://a.org/x", "http://a.org/x", False),
        ("https://a.org/x", "file:///etc/passwd", False),
        ("http://a.org/x", "https://a.org/x", True),
        ("http://a.org/x", "file:///etc/passwd", False),
        ("https://a.org/x", "ftp://a.org/x", False),
    ],
)
def test_redirects_never_leave_https(start: str, target: str, followed: bool) -> None:
    assert may_lead(start, target) is followed


@pytest.mark.parametrize("url", ["file:///etc/hostname", "ftp://127.0.0.1/f", "data:,abc"])
def test_an_address_is_http(tmp_path: Path, url: str) -> None:
    assert "unknown url type" in refusal(RemoteFile(url, 3, "0" * 64), tmp_path / "f")


def test_a_server_that_falls_silent_is_asked_again(server: Any, tmp_path: Path) -> None:
    file, served = server.add("f.bin", CONTENT, pause=30.0)
    patience = replace(QUICK, timeout_seconds=0.2, step_bytes=1 << 20)
    assert "no answer in time" in refusal(file, tmp_path / "f.bin", patience)
    assert served.asked == ["", "bytes=16384-", "bytes=32768-"]


def test_a_trickle_is_as_good_as_silence(server: Any, tmp_path: Path) -> None:
    file, served = server.add("f.bin", CONTENT, pause=0.05, block=5)
    assert "too slow" in refusal(file, tmp_path / "f.bin", replace(QUICK, timeout_seconds=0.3))
    assert len(served.asked) == 3


def test_no_network_is_one_line(tmp_path: Path, server: Any) -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    closed = RemoteFile(f"http://127.0.0.1:{port}/f.bin", 10, "0" * 64)
    assert "could not be fetched: Connection refused" in refusal(closed, tmp_path / "f.bin")
    unknown = RemoteFile("http://no-such-host.invalid/f.bin", 10, "0" * 64)
    assert "could not be fetched: " in refusal(unknown, tmp_path / "f.bin", replace(QUICK, tries=1))


def test_waits_grow_and_are_told(
    server: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    waits: list[float] = []
    monkeypatch.setattr(
        "splashbench.download.fetch.time", SimpleNamespace(sleep=waits.append, monotonic=time.monotonic)
    )
    file, _ = server.add("f.bin", CONTENT, statuses=[503] * 5)
    refusal(file, tmp_path / "f.bin", Patience())
    assert waits == [1.0, 2.0, 4.0, 8.0]
    assert capsys.readouterr().err.splitlines() == [
        f"f.bin: again in {seconds} s: the server answered 503 Service Unavailable" for seconds in (1, 2, 4, 8)
    ]


def test_no_room_is_told_before_the_first_byte(server: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file, served = server.add("f.bin", CONTENT)
    monkeypatch.setattr(shutil, "disk_usage", lambda folder: SimpleNamespace(free=1000))
    with pytest.raises(SplashbenchError, match=r"has room for 1 kB, and f\.bin takes 300 kB; free some space"):
        fetch(file, tmp_path / "f.bin", remedy=REMEDY)
    assert served.asked == []


def test_a_full_disk_is_one_line_and_leaves_nothing(server: Any, tmp_path: Path) -> None:
    file, _ = server.add("f.bin", CONTENT)
    code = f"import resource; resource.setrlimit(resource.RLIMIT_FSIZE, (90_000, 90_000))\n{script(file, tmp_path)}"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert "the disk is full; free some space" in done.stderr.splitlines()[-1]
    assert [path.name for path in tmp_path.iterdir()] == [".f.bin.lock"]


def script(file: RemoteFile, folder: Path) -> str:
    """A program that fetches `file` into `folder`."""
    return (
        # What a shell runs in the background ignores SIGINT, and hands that on.
        "import signal, sys\nfrom pathlib import Path\nsignal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "from splashbench.download.fetch import RemoteFile, alone, fetch\n"
        f"file, target = RemoteFile(*{(file.url, file.size, file.sha256)!r}), Path({str(folder / 'f.bin')!r})\n"
        "with alone(target, lambda text: print(text, file=sys.stderr)):\n    fetch(file, target, remedy='-')\n"
    )


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGINT])
def test_a_killed_download_is_continued(
    server: Any, tmp_path: Path, wait_for: Callable[[Callable[[], bool]], None], number: signal.Signals
) -> None:
    file, served = server.add("f.bin", CONTENT, pause=0.05)
    part = tmp_path / "f.bin.part"
    process = subprocess.Popen([sys.executable, "-c", script(file, tmp_path)], stderr=subprocess.DEVNULL)
    wait_for(lambda: part.is_file() and part.stat().st_size > 40_000)
    process.send_signal(number)
    assert process.wait(60) != 0
    have = part.stat().st_size
    assert 40_000 < have < len(CONTENT)
    served.pause = 0.0
    with alone(tmp_path / "f.bin", pytest.fail):  # the dead process holds it no more
        assert get(file, tmp_path / "f.bin") == CONTENT
    assert served.asked == ["", f"bytes={have}-"]


def test_of_two_processes_one_fetches_and_one_waits(server: Any, tmp_path: Path) -> None:
    file, served = server.add("f.bin", CONTENT, pause=0.05)
    command = [sys.executable, "-c", script(file, tmp_path)]
    processes = [subprocess.Popen(command, stderr=subprocess.PIPE, text=True) for _ in range(2)]
    told = [process.communicate(timeout=60)[1] for process in processes]
    assert [process.returncode for process in processes] == [0, 0]
    assert (tmp_path / "f.bin").read_bytes() == CONTENT
    assert served.asked == [""]
    assert sum("waiting for it" in text for text in told) <= 1
