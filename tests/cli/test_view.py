"""`splashbench view`: what it says and refuses, where it listens, and how it ends."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any
from urllib.request import urlopen

import pytest

from splashbench.cli.main import main

pytest.importorskip("viser", reason="comes with the extra [view]")

Fails = Callable[..., str]


class Running:
    """`splashbench view` in a process of its own, until it has said its address."""

    def __init__(self, *words: object, env: dict[str, str] | None = None) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-m", "splashbench", "view", *map(str, words)],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env={**os.environ, "DISPLAY": "", "WAYLAND_DISPLAY": ""} | (env or {}),
        )
        self.said: list[str] = []
        assert self.process.stderr is not None
        for line in self.process.stderr:
            self.said.append(line.rstrip("\n"))
            if "Ctrl-C ends it" in line:
                break

    def end(self, number: int = signal.SIGINT) -> tuple[int, str, str]:
        """Exit status, standard output and what else it said, after a signal."""
        self.process.send_signal(number)
        out, err = self.process.communicate(timeout=60)
        return self.process.returncode, out, err


@pytest.fixture
def start() -> Iterator[Callable[..., Running]]:
    started: list[Running] = []

    def run(*words: object, **more: Any) -> Running:
        started.append(Running(*words, **more))
        return started[-1]

    yield run
    for running in started:
        if running.process.poll() is None:
            running.process.kill()
            running.process.communicate()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_it_serves_until_it_is_interrupted(
    balls_directory: Path, start: Callable[..., Running], number: signal.Signals
) -> None:
    running = start(balls_directory, "--no-open", "--json")
    assert running.said[0].endswith("scene balls, 8 timesteps in 0.34 s, 7 cameras")
    address = running.said[-1].split()[2].rstrip(";")
    assert address.startswith("http://127.0.0.1:")
    with urlopen(address, timeout=20) as page:
        assert b"Viser" in page.read()
    status, out, err = running.end(number)
    assert status == 128 + number
    assert err == "\ninterrupted; nothing half-written was left\n"
    told = json.loads(out)
    assert told["address"] == address
    assert told["timesteps"] == 8
    assert told["shown"][0]["name"] == "scene balls"
    with pytest.raises(OSError):
        urlopen(address, timeout=5)


def test_two_halves_say_all_ports(balls_directory: Path, truth: Path, start: Callable[..., Running]) -> None:
    running = start(truth, balls_directory, "--no-open", "--json")
    status, out, err = running.end()
    assert status == 130
    assert "Traceback" not in err
    told = json.loads(out)
    assert len(told["ports"]) == 3
    assert f"(and ports {told['ports'][1]}, {told['ports'][2]})" in running.said[-1]
    assert [each["name"] for each in told["shown"]] == ["oracle (truth)", "scene balls"]


def test_the_network_is_warned_of(balls_directory: Path, start: Callable[..., Running]) -> None:
    running = start(balls_directory, "--host", "0.0.0.0", "--no-open")
    warning = "warning: listening on 0.0.0.0, so anybody on the network can look and press the buttons"
    assert warning in running.said
    assert running.end()[0] == 130


def test_without_a_screen_nothing_is_opened(balls_directory: Path, start: Callable[..., Running]) -> None:
    running = start(balls_directory)
    assert "there is no screen here to open a browser on; open the address yourself" in running.said
    assert running.end()[0] == 130


def test_a_port_that_is_in_use_is_one_line(balls_directory: Path, fails: Fails) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        line = fails("view", balls_directory, "--port", port, "--no-open")
    assert line == f"error: port {port} is in use; give another --port, or none and the next free one is taken"


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["nowhere"], "nowhere is not a folder; give the folder of a scene or of a submission"),
        (["--camera", "9", "--screenshot", "a.png"], "has no camera '9'; choose one of 1, 2, 3, 4, 5, 6, 7"),
        (["--show", "water", "--no-open"], "there is no layer 'water'; choose of points, particles, surface"),
        (["--screenshot", "a.jpg"], "a.jpg: the picture is a PNG; give a name that ends in .png"),
        (["--host", "no such host", "--no-open"], "no such host is no address"),
    ],
)
def test_what_is_refused_is_one_line(
    words: Sequence[str],
    said: str,
    balls_directory: Path,
    fails: Fails,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    places = [] if words[0] == "nowhere" else [balls_directory]
    assert said in fails("view", *places, *words)
    assert list(tmp_path.iterdir()) == []


def test_a_method_of_none_of_the_places_is_one_line(balls_directory: Path, truth: Path, fails: Fails) -> None:
    method = f"{Path(__file__).parents[2] / 'methods' / 'hull_points' / 'hull_points.py'}:HullPoints"
    line = fails("view", balls_directory, truth, "--method", method, "--no-open")
    assert line.endswith("is 'hull_points', and nothing that is to be seen is of it; leave it out")


def test_a_folder_for_screenshots_that_is_a_file_is_refused(
    balls_directory: Path, fails: Fails, tmp_path: Path
) -> None:
    (tmp_path / "file").write_text("")
    assert "is a file; give another place" in fails("view", balls_directory, "--save-to", tmp_path / "file" / "x")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["a", "b", "c"], "two can be seen side by side, not 3"),
        (["a", "--camera", "1"], "--camera is for --screenshot"),
        (["a", "--time", "nan"], "'nan' is not a number of seconds"),
        (["a", "--port", "0"], "'0' is not a whole number from 1 to 65535"),
        (["a", "b", "--screenshot", "c.png", "--size", "451x300"], "--size: a width of 451 does not halve"),
        (["a", "--size", "450x300"], "--size is for --screenshot"),
        (["a", "--screenshot", "c.png", "--port", "8090"], "--port would do nothing with --screenshot"),
        (["a", "--screenshot", "c.png", "--save-to", "b"], "--save-to would do nothing with --screenshot"),
    ],
)
def test_wrong_usage(words: list[str], said: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["view", *words])
    assert stop.value.code == 2
    assert said in capsys.readouterr().err


def test_without_a_browser_a_screenshot_is_one_line(
    balls_directory: Path, fails: Fails, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("splashbench.viewer.browser.PROGRAMS", ("no-such-browser",))
    line = fails("view", balls_directory, "--screenshot", tmp_path / "a.png")
    assert "a screenshot needs a browser, one of no-such-browser (Debian: apt install chromium)" in line
    assert not (tmp_path / "a.png").exists()


def test_without_viser_the_extra_is_named(balls_directory: Path, fails: Fails, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "viser", None)
    assert "pip install -c constraints.txt -e '.[view]'" in fails("view", balls_directory)
